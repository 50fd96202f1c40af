"""Operations and bytes of the work that is timed: of the renderer in closed form, of U-Nets counted."""

from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from harness import Work
from nerfdiff.cameras import Cameras
from nerfdiff.model import NerfDiff, build_on_meta
from nerfdiff.render.renderer import Renderer

NUMBER = 4
"""Bytes of the renderer's numbers: planes, rays and colours are fp32."""


def rendering(renderer: Renderer, config: dict[str, Any], plane: int, rays: int, scenes: int, backward: bool) -> Work:
    """Count the cost of rendering `rays` rays in each of `scenes` scenes.

    Operations: at every sample three bilinear gathers (4 taps, a multiplication and an addition each), and the two
    layers; the backward pass costs twice as much (recomputing is not counted). Bytes: the least that must move if
    caches held the rest: planes and decoder once, rays in and colours out; backwards planes and decoder once more,
    and their gradients out.

    Args:
        config: of the model.
        plane: side of the planes, in texels.
        backward: with gradients to planes and decoder.
    """
    channels, hidden = config["field"]["channels"], config["field"]["hidden"]
    per_point = 3 * 4 * 2 * channels + 2 * hidden * (channels + 4)
    flops = per_point * renderer.samples_per_ray * rays * scenes * (3 if backward else 1)
    parameters = 3 * channels * plane**2 + hidden * (channels + 1) + 4 * (hidden + 1)
    moved = parameters * (3 if backward else 1) + rays * (8 + 5) * (2 if backward else 1)
    return Work(flops, NUMBER * moved * scenes)


def encoding(config: dict[str, Any], size: int, dtype: torch.dtype) -> Work:
    """Count the cost of encoding one image; see `counted`."""
    model = build_on_meta(config)
    return counted(lambda: _encoded(model, size, 1), dtype)


def denoising(config: dict[str, Any], size: int, views: int, dtype: torch.dtype) -> Work:
    """Count the cost of one evaluation of the CDM for `views` views of one scene, given its features."""
    model = build_on_meta(config)
    return counted(_denoise(model, size, 1, views), dtype)


def training(config: dict[str, Any], size: int, batch: int, targets: int, dtype: torch.dtype) -> Work:
    """Count the cost of a training step: a layer's backward pass is two forward ones; recomputing is left out."""
    model = build_on_meta(config)
    parts = [
        counted(lambda: _encoded(model, size, batch), dtype),
        counted(_denoise(model, size, batch, targets), dtype),
    ]
    rendered = rendering(model.renderer, config, size, targets * size**2, batch, backward=True)
    return Work(3 * sum(p.flops for p in parts) + rendered.flops, 3 * sum(p.bytes for p in parts) + rendered.bytes)


def counted(call: Callable[[], Any], dtype: torch.dtype) -> Work:
    """Count the cost of a call on the meta device: products and convolutions as PyTorch counts them, and
    the bytes of all inputs and outputs of its operators, as if each went through memory once.

    Args:
        dtype: of the tensors when it is computed in earnest; on the meta device they are fp32.
    """
    with torch.no_grad(), FlopCounterMode(display=False) as flops, Traffic() as traffic:
        call()
    return Work(float(flops.get_total_flops()), traffic.bytes * dtype.itemsize / NUMBER)


class Traffic(TorchDispatchMode):
    """Sums the bytes that operators read and write; views move none."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if not func.is_view:
            tensors = [leaf for leaf in tree_leaves((args, kwargs, out)) if isinstance(leaf, torch.Tensor)]
            self.bytes += sum(tensor.nbytes for tensor in tensors)
        return out


def _encoded(model: NerfDiff, size: int, batch: int):
    with torch.device("meta"):
        cameras = Cameras(torch.empty(batch, 4, 4), torch.empty(batch, 3, 3), size, size)
        return model.encode_images(torch.empty(batch, 3, size, size), cameras, torch.empty(batch), torch.empty(batch))


def _denoise(model: NerfDiff, size: int, batch: int, views: int) -> Callable[[], Any]:
    with torch.device("meta"), torch.no_grad():
        encoding = _encoded(model, size, batch)
        cameras = Cameras(torch.empty(batch, views, 4, 4), torch.empty(batch, views, 3, 3), size, size)
        condition = model.condition(encoding, cameras, torch.empty(batch, views, 3, size, size))
        z, t = torch.empty(batch * views, 3, size, size), torch.empty(batch * views)

    def call():
        with torch.device("meta"):
            return model.denoiser.velocity(z, t, condition)

    return call
