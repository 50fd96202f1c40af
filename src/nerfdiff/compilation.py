"""The U-Nets, or their blocks, compiled, with what was compiled kept on disk for the next run."""

import logging
import os
from pathlib import Path

import torch

from nerfdiff.diffusion.unet import Stage, UNet
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)

REGIONS = {"unets": UNet, "blocks": Stage}
CHOICES = ("none", *REGIONS)
CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"
VERSIONS = {"unets": 32, "blocks": 256}
"""Most compiled variants of both U-Nets together (sizes, gradients, precision, deep levels); more run uncompiled."""


def compile_unets(model: NerfDiff, choice: str, cache: str | Path, backend: str = "inductor") -> None:
    """Let `torch.compile` take the encoder's and the CDM's U-Net, or their blocks, when they are first called.

    `unets` takes each U-Net as one region. `blocks` takes each `Stage`, and those of the same sizes once: 36 of B's 54,
    36 of L's 74. Each call of a block then looks through the versions of the others, which costs nothing where a CUDA
    graph replays them (`train_resident`). The renderer stays as it is: fused or not, it gained nothing when compiled.

    In place: names of parameters, checkpoints and copies (of which the average of the weights is one) are those of the
    plain model. Every number of images at once, with gradients or without, is compiled for itself.

    Args:
        choice: `none` leaves all as it is; `unets`; `blocks`.
        cache: folder that keeps what was compiled, unless the variable TORCHINDUCTOR_CACHE_DIR names one.
        backend: of `torch.compile`.

    Raises:
        ConfigError: another choice.
    """
    if choice not in CHOICES:
        raise ConfigError(f"compile={choice!r}: choose {', '.join(CHOICES)}")
    if choice == "none":
        return
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # slow to import

    # PyTorch notes its own choice, in a temporary folder, in the same variable as soon as it has made one
    if os.environ.get(CACHE_VARIABLE) in (None, default_cache_dir()):
        os.environ[CACHE_VARIABLE] = str(Path(cache).absolute())
    log.info("%s are compiled at their first call; %s keeps the result", choice, os.environ[CACHE_VARIABLE])
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, VERSIONS[choice])
    for module in model.modules():
        if isinstance(module, REGIONS[choice]):
            module.compile(backend=backend, dynamic=False)
