"""The ways in which one piece of work can be done: the reference first, then whatever this machine can do faster."""

import copy
import logging
from dataclasses import replace

import torch

from harness import Unavailable
from nerfdiff.cameras import Cameras, Rays
from nerfdiff.cli import CONF
from nerfdiff.compilation import compile_unets
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.model import NerfDiff
from nerfdiff.render.backend import fused
from nerfdiff.render.renderer import Renderer


def renderers(model: NerfDiff, renderer: Renderer) -> dict[str, Renderer | Unavailable]:
    """`renderer` by backend; `torch` is the reference.

    Args:
        model: whose decoder and planes it is to render.
    """
    kernels = replace(renderer, backend="triton")
    reason = _obstacle(model, kernels)
    ways = {"torch": replace(renderer, backend="torch"), "triton": kernels if reason is None else Unavailable(reason)}
    if next(model.parameters()).device.type == "cpu":
        ways["CPU field"] = replace(renderer, backend="auto")
    return ways


def kinds(compiled: bool) -> tuple[str, ...]:
    """Return the ways U-Nets may run; eager in PyTorch's own memory layout is the reference.

    Args:
        compiled: whether to compile them too, which takes up to minutes at the first call.
    """
    return ("eager", "channels_last", "compiled") if compiled else ("eager", "channels_last")


def as_kind(model: NerfDiff, kind: str) -> NerfDiff:
    """The model, changed in place. Copies of a compiled model are not compiled: copy before."""
    if kind != "eager":
        model.to(memory_format=torch.channels_last)
    if kind == "compiled":
        compile_unets(model, "unets", CONF.parent / "data" / "cache" / "compiled")
    return model


def models(model: NerfDiff, compiled: bool) -> dict[str, NerfDiff]:
    """By kind: the model itself, and copies."""
    return {kind: model if kind == "eager" else as_kind(copy.deepcopy(model), kind) for kind in kinds(compiled)}


def _obstacle(model: NerfDiff, kernels: Renderer) -> str | None:
    """Return why the fused renderer cannot render these; None where it can."""
    device = next(model.parameters()).device
    if device.type != "cuda":
        return "needs a CUDA GPU"
    with torch.no_grad(), torch.device(device):
        eye, K, near = torch.eye(4)[None], torch.eye(3)[None], torch.ones(1)
        planes = torch.zeros(1, 3, model.encoder.channels, 8, 8)
        field = RefinedField(Triplane(planes, Cameras(eye, K, 8, 8), near, 2 * near), model.decoder)
        ahead = torch.tensor([0.0, 0.0, 1.0]).expand(1, 16, 3)
        rays = Rays(torch.zeros_like(ahead), ahead, near[:, None].expand(1, 16), 2 * near[:, None].expand(1, 16))
        with _Heard("nerfdiff.render.backend") as heard:
            rendered = fused(kernels, field.field(), rays, None)
    return None if rendered is not None else heard.last or "the fused renderer hands over to the reference"


class _Heard(logging.Handler):
    """The last line that a logger said."""

    def __init__(self, name: str):
        super().__init__()
        self.logger, self.last = logging.getLogger(name), None

    def emit(self, record: logging.LogRecord) -> None:
        self.last = record.getMessage()

    def __enter__(self) -> "_Heard":
        self.logger.addHandler(self)
        return self

    def __exit__(self, *error) -> None:
        self.logger.removeHandler(self)
