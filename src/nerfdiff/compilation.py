"""The U-Nets compiled, with what was compiled kept on disk for the next run."""

import logging
import os
from pathlib import Path

import torch
from torch import nn

from nerfdiff.diffusion.unet import UNet
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)

CHOICES = ("none", "unets")
CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"
VERSIONS = 32
"""Most compiled variants of both U-Nets together (sizes, gradients, precision, deep levels); more run uncompiled."""


def compile_unets(model: NerfDiff, choice: str, cache: str | Path, backend: str = "inductor") -> None:
    """Let `torch.compile` take the encoder's and the CDM's U-Net, each as one region, when they are first called.

    A region is a whole U-Net: hardly two of its blocks have the same sizes, so that smaller ones would be as many to
    compile, and each call of a block would look through the versions of all the others. The renderer stays as it is:
    fused or not, it gained nothing when compiled.

    In place: names of parameters, checkpoints and copies (of which the average of the weights is one) are those of the
    plain model. Every number of images at once, with gradients or without, is compiled for itself.

    Args:
        choice: `none` leaves all as it is; `unets`.
        cache: folder that keeps what was compiled, unless the variable TORCHINDUCTOR_CACHE_DIR names one.
        backend: of `torch.compile`.

    Raises:
        ConfigError: another choice.
    """
    if choice not in CHOICES:
        raise ConfigError(f"compile={choice!r}: choose {' or '.join(CHOICES)}")
    if choice == "none":
        return
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # slow to import

    # PyTorch notes its own choice, in a temporary folder, in the same variable as soon as it has made one
    if os.environ.get(CACHE_VARIABLE) in (None, default_cache_dir()):
        os.environ[CACHE_VARIABLE] = str(Path(cache).absolute())
    log.info("the U-Nets are compiled at their first call; %s keeps the result", os.environ[CACHE_VARIABLE])
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, VERSIONS)
    for unet in _unets(model):
        unet.compile(backend=backend, dynamic=False)


def _unets(model: NerfDiff) -> list[nn.Module]:
    """Return both U-Nets; a pixel-aligned NeRF has only the CDM's."""
    return [module for module in model.modules() if isinstance(module, UNet)]
