"""Subjects of benchmarks: a model of any size, and scenes made of noise, on a device."""

import argparse
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate

from harness import Limits, limits
from nerfdiff.cameras import Cameras
from nerfdiff.checkpoint import load_model
from nerfdiff.cli import CONF, load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors import Prior
from nerfdiff.evaluation.run import choose_device
from nerfdiff.model import NerfDiff, settings_of
from nerfdiff.utils.config import auto_precision

SIZES = {"tiny": 32, "small": 64, "base": 128, "large": 128}
"""Pixels that the models are made for."""
FOCAL = 131.25 / 128
"""SRN's focal length, in image widths."""


@dataclass(frozen=True)
class Subject:
    """A model on a device.

    Args:
        name: of the model or checkpoint.
        config: arguments of `NerfDiff`.
        size: image side in pixels.
    """

    name: str
    model: NerfDiff
    config: dict[str, Any]
    size: int
    device: torch.device
    precision: str

    @property
    def dtype(self) -> torch.dtype:
        """Type of matrix products."""
        return torch.bfloat16 if self.precision == "bf16-mixed" else torch.float32

    def autocast(self) -> AbstractContextManager:
        """bf16 products where the precision asks for them."""
        if self.precision == "32-true":
            return nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16, cache_enabled=False)

    def limits(self, seconds: float) -> Limits:
        """Measure the device's limits in this precision."""
        return limits(self.device, self.dtype, min(seconds, 2.0))


def subject(arguments: argparse.Namespace) -> Subject:
    """The model that the options ask for.

    Raises:
        UserError: no such checkpoint, device or config.
    """
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    device = choose_device(arguments.device)
    precision = auto_precision(device.type) if arguments.precision == "auto" else arguments.precision
    if arguments.ckpt is not None:
        loaded = load_model(arguments.ckpt, "ema", CONF.parent / "assets")
        size = arguments.size or (loaded.image_size or [128])[0]
        return Subject(Path(arguments.ckpt).name, loaded.model.to(device), dict(loaded.config), size, device, precision)
    cfg = load_config("train", [f"model={arguments.model}", "data=srn_cars", *arguments.overrides])
    config = settings_of(cfg)
    torch.manual_seed(0)
    with device:
        model = NerfDiff(**config).eval()
        for parameter in model.parameters():
            if not parameter.any():  # layers that begin as zero: arithmetic on zeros is faster than on numbers
                torch.nn.init.normal_(parameter.data, std=0.02)
    return Subject(arguments.model, model, config, arguments.size or SIZES[arguments.model], device, precision)


@lru_cache
def _spiral(views: int) -> Prior:
    return instantiate(
        load_config("distill", ["ckpt=none", "prior=srn_spiral", "prior.radius=1.3", f"budget.views={views}"]).prior
    )


def scene(subject: Subject, views: int, batch: int = 1, seed: int = 0) -> ViewBatch:
    """`batch` scenes of noise in the frustum of SRN's cars, each with `views` other cameras of its test spiral."""
    size, noise = subject.size, torch.Generator().manual_seed(seed)
    K = torch.tensor([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1]])
    source = Cameras(torch.eye(4).repeat(batch, 1, 1), K.repeat(batch, 1, 1), size, size)
    pixels = torch.randint(0, 256, (batch, 1 + views, 3, size, size), generator=noise, dtype=torch.uint8)
    made = ViewBatch(
        draws=torch.arange(batch),
        source_pixels=pixels[:, 0],
        source_cameras=source,
        target_pixels=pixels[:, 1:],
        target_cameras=source[:, None],
        near=torch.full((batch,), 0.8),
        far=torch.full((batch,), 1.8),
        scene_ids=tuple(f"noise{seed + number}" for number in range(batch)),
        source_views=("input",) * batch,
        target_views=(tuple(f"{view:03d}" for view in range(views)),) * batch,
    )
    around = _spiral(views)(made)
    made.target_cameras = Cameras(around.c2w.repeat(batch, 1, 1, 1), around.K.repeat(batch, 1, 1, 1), size, size)
    return made.to(subject.device)
