"""The fused GroupNorm as one differentiable operation."""

from collections.abc import Callable
from typing import NamedTuple

import torch
import triton
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfdiff.diffusion.kernels.norm_silu import apply_kernel, coefficients_kernel, sums_kernel
from nerfdiff.diffusion.kernels.norm_silu_gradient import (
    gradient_apply_kernel,
    gradient_coefficients_kernel,
    gradient_sums_kernel,
)

Features = Float[Tensor, "batch channels height width"]

_TILE = 4096
"""Numbers that a program holds at once."""
_PIXELS = 256
"""Pixels of an image that one program sums up, at least."""


class Settings(NamedTuple):
    """Settings of a norm that stay from call to call.

    Args:
        groups: of channels; a power of 2.
        eps: added to the variance.
        active: true if SiLU follows.
    """

    groups: int
    eps: float
    active: bool


class FusedNorm(torch.autograd.Function):
    """Fused norm; keeps for the backward pass the parameters, x and four numbers per image and channel."""

    @staticmethod
    def forward(ctx, settings, dtype, recover, x, weight, bias, scale_shift):
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.cuda.device_of(x):  # kernels start on the current device
            out, coefficients = _normalize(settings, dtype, x, weight, bias, scale_shift)
        ctx.settings, ctx.recover = settings, recover
        ctx.save_for_backward(x, weight, bias, scale_shift, coefficients)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        *tensors, coefficients = ctx.saved_tensors
        needed = ctx.needs_input_grad[3:]
        try:
            with torch.cuda.device_of(gradient):
                found = _gradients(ctx.settings, tensors, coefficients, gradient, needed)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            found = ctx.recover(error, tensors, gradient, needed)
        return None, None, None, *found


def fused_norm(
    settings: Settings,
    dtype: torch.dtype,
    recover: Callable,
    x: Features,
    weight: Float[Tensor, "channels"],
    bias: Float[Tensor, "channels"],
    scale_shift: Float[Tensor, "batch 2*channels"] | None,
) -> Features:
    """GroupNorm(x) · (1 + scale) + shift, and the SiLU of that, computed in fp32 and given in channels_last.

    Differentiable, once, in all four tensors; their gradients are of their types, and x's is in channels_last.

    Args:
        dtype: of the output.
        recover: called where the backward pass fails, with the error, the four tensors, the output's gradient and
            which of the four need one; returns those gradients.
        scale_shift: scale and then shift of every channel; None: neither.
    """
    return FusedNorm.apply(settings, dtype, recover, x, weight, bias, scale_shift)


class _Sizes(NamedTuple):
    """Division of the work on [images, pixels, channels]: `parts` times `steps` times `rows` pixels.

    Args:
        padded: channels, up to a power of 2.
    """

    images: int
    pixels: int
    channels: int
    padded: int
    rows: int
    steps: int
    parts: int

    @property
    def tiles(self) -> tuple[int, int]:
        """The grid of what passes over the images tile by tile."""
        return self.images, triton.cdiv(self.pixels, self.rows)


def _sizes(x: Tensor) -> _Sizes:
    images, channels, height, width = x.shape
    pixels, padded = height * width, triton.next_power_of_2(channels)
    rows = max(1, _TILE // padded)
    steps = triton.cdiv(min(_PIXELS, pixels), rows)
    return _Sizes(images, pixels, channels, padded, rows, steps, triton.cdiv(pixels, steps * rows))


def _numbers(x: Tensor, *shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.float32, device=x.device)


def _normalize(settings, dtype, x, weight, bias, scale_shift) -> tuple[Tensor, Tensor]:
    """The output, and mean, 1 / standard deviation, a and b of each channel (see coefficients_kernel)."""
    images, pixels, channels, padded, rows, steps, parts = sizes = _sizes(x)
    sums = _numbers(x, images, parts, 2, channels)
    coefficients = _numbers(x, images, 4, channels)
    out = torch.empty_like(x, dtype=dtype, memory_format=torch.channels_last)
    modulation = x if scale_shift is None else scale_shift.contiguous()
    size = channels // settings.groups
    sums_kernel[(images, parts)](x, sums, pixels, C=channels, CP=padded, R=rows, STEPS=steps)
    coefficients_kernel[(images,)](
        x, sums, weight, bias, modulation, coefficients, pixels, parts, settings.eps,
        MODULATED=scale_shift is not None, GROUPS=settings.groups, SIZE=size, SP=triton.next_power_of_2(size),
    )  # fmt: skip
    apply_kernel[sizes.tiles](x, coefficients, out, pixels, ACTIVE=settings.active, C=channels, CP=padded, R=rows)
    return out, coefficients


def _gradients(settings, tensors, coefficients, gradient, needed) -> list[Tensor | None]:
    """Compute the gradients of x, weight, bias and scale_shift, where needed."""
    x, weight, bias, scale_shift = tensors
    images, pixels, channels, padded, rows, steps, parts = sizes = _sizes(x)
    gradient = gradient.contiguous(memory_format=torch.channels_last)
    common = {"ACTIVE": settings.active, "C": channels, "CP": padded, "R": rows}
    sums = _numbers(x, images, parts, 2, channels)
    gradient_sums_kernel[(images, parts)](x, gradient, coefficients, sums, pixels, STEPS=steps, **common)

    slopes = _numbers(x, images, 2, channels)
    affine = needed[1] or needed[2]
    d_affine = _numbers(x, images, 2, channels) if affine else None
    d_scale_shift = torch.empty_like(scale_shift, memory_format=torch.contiguous_format) if needed[3] else None
    modulation = x if scale_shift is None else scale_shift.contiguous()
    size = channels // settings.groups
    # where there is nothing to write, `slopes` stands in for where to
    gradient_coefficients_kernel[(images,)](
        sums, coefficients, weight, bias, modulation,
        slopes, d_affine if affine else slopes, d_scale_shift if needed[3] else slopes, pixels, parts,
        MODULATED=scale_shift is not None, AFFINE=affine, MODULATION=needed[3],
        GROUPS=settings.groups, SIZE=size, SP=triton.next_power_of_2(size),
    )  # fmt: skip
    d_weight, d_bias = d_affine.sum(0) if affine else (None, None)

    d_x = torch.empty_like(x, memory_format=torch.channels_last) if needed[0] else None
    if needed[0]:
        gradient_apply_kernel[sizes.tiles](x, gradient, coefficients, slopes, d_x, pixels, **common)
    return [
        d_x,
        d_weight.to(weight.dtype) if needed[1] else None,
        d_bias.to(bias.dtype) if needed[2] else None,
        d_scale_shift,
    ]
