"""The backward pass of GroupNorm, scale, shift and SiLU: image and gradient are read twice, one gradient is written.

What lies between x and the output is made again from x and the forward pass's coefficients [images, 4, C]: mean,
1 / standard deviation, a and b of each channel, for h = a (x − mean) + b and the output SiLU(h). No sum depends on the
order in which programs run.
"""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.diffusion.kernels.norm_silu import totals


@triton.jit
@no_type_check
def gradient_sums_kernel(
    x, gradient, coefficients, sums, pixels,
    ACTIVE: tl.constexpr, C: tl.constexpr, CP: tl.constexpr, R: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Per channel, the sums of h's gradient and of its product with the normalized x, over R · STEPS pixels.

    Args:
        x, gradient: [images, pixels, C], the latter the output's.
        sums: [images, parts, 2, C] in fp32, out.
    """
    image, part = tl.program_id(0).to(tl.int64), tl.program_id(1)
    channel = tl.arange(0, CP)
    known = channel < C
    coefficients += image * 4 * C
    mean = tl.load(coefficients + channel, mask=known, other=0.0)
    inverse = tl.load(coefficients + C + channel, mask=known, other=0.0)
    a = tl.load(coefficients + 2 * C + channel, mask=known, other=0.0)
    b = tl.load(coefficients + 3 * C + channel, mask=known, other=0.0)
    first = tl.zeros([CP], tl.float32)
    second = tl.zeros([CP], tl.float32)
    for step in range(STEPS):
        pixel = (part * STEPS + step) * R + tl.arange(0, R)
        here = (pixel < pixels)[:, None] & known[None, :]
        at = image * pixels * C + pixel[:, None] * C + channel[None, :]
        away = tl.load(x + at, mask=here, other=0.0).to(tl.float32) - mean[None, :]
        d_h = _of_h(gradient + at, here, a[None, :] * away + b[None, :], ACTIVE)
        first += tl.sum(d_h, 0)
        second += tl.sum(d_h * away, 0)
    sums += (image * tl.num_programs(1) + part) * 2 * C
    tl.store(sums + channel, first, mask=known)
    tl.store(sums + C + channel, second * inverse, mask=known)


@triton.jit
@no_type_check
def gradient_coefficients_kernel(
    sums, coefficients, weight, bias, scale_shift, slopes, d_affine, d_scale_shift, pixels, parts,
    MODULATED: tl.constexpr, AFFINE: tl.constexpr, MODULATION: tl.constexpr,
    GROUPS: tl.constexpr, SIZE: tl.constexpr, SP: tl.constexpr,
):  # fmt: skip
    """Compute the terms of x's gradient through the group's mean and variance, and the gradients of weight, bias,
    scale and shift.

    Args:
        scale_shift: [images, 2, C], where MODULATED.
        slopes: [images, 2, C] in fp32, out: c and d, so that x's gradient is a (gradient of h) + c (x − mean) + d.
        d_affine: [images, 2, C] in fp32, out where AFFINE: gradients of weight and bias through each image.
        d_scale_shift: [images, 2, C], out where MODULATION.
    """
    image = tl.program_id(0).to(tl.int64)
    C = GROUPS * SIZE
    member = tl.arange(0, SP)[None, :]
    channel = tl.arange(0, GROUPS)[:, None] * SIZE + member
    known = (member < SIZE) & (channel < C)
    first, second = totals(sums + image * parts * 2 * C, parts, C, channel, known)
    inverse = tl.load(coefficients + image * 4 * C + C + channel, mask=known, other=0.0)
    a = tl.load(coefficients + image * 4 * C + 2 * C + channel, mask=known, other=0.0)
    count = 1.0 * SIZE * pixels
    c = -inverse * (tl.sum(a * second, 1) / count)[:, None]
    d = tl.broadcast_to((-tl.sum(a * first, 1) / count)[:, None], [GROUPS, SP])
    at = image * 2 * C + channel
    tl.store(slopes + at, c, mask=known)
    tl.store(slopes + C + at, d, mask=known)
    if MODULATION:
        kind = d_scale_shift.dtype.element_ty
        w = tl.load(weight + channel, mask=known, other=0.0).to(tl.float32)
        d_scale = w * second + tl.load(bias + channel, mask=known, other=0.0).to(tl.float32) * first
        tl.store(d_scale_shift + at, d_scale.to(kind), mask=known)
        tl.store(d_scale_shift + C + at, first.to(kind), mask=known)
    if AFFINE:
        if MODULATED:
            scale = 1 + tl.load(scale_shift + at, mask=known, other=0.0).to(tl.float32)
            first *= scale
            second *= scale
        tl.store(d_affine + at, second, mask=known)
        tl.store(d_affine + C + at, first, mask=known)


@triton.jit
@no_type_check
def gradient_apply_kernel(
    x, gradient, coefficients, slopes, out, pixels,
    ACTIVE: tl.constexpr, C: tl.constexpr, CP: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """x's gradient, for R pixels per program."""
    image = tl.program_id(0).to(tl.int64)
    channel = tl.arange(0, CP)
    known = channel < C
    coefficients += image * 4 * C
    slopes += image * 2 * C
    mean = tl.load(coefficients + channel, mask=known, other=0.0)
    a = tl.load(coefficients + 2 * C + channel, mask=known, other=0.0)
    b = tl.load(coefficients + 3 * C + channel, mask=known, other=0.0)
    c = tl.load(slopes + channel, mask=known, other=0.0)
    d = tl.load(slopes + C + channel, mask=known, other=0.0)
    pixel = tl.program_id(1) * R + tl.arange(0, R)
    here = (pixel < pixels)[:, None] & known[None, :]
    at = image * pixels * C + pixel[:, None] * C + channel[None, :]
    away = tl.load(x + at, mask=here, other=0.0).to(tl.float32) - mean[None, :]
    d_h = _of_h(gradient + at, here, a[None, :] * away + b[None, :], ACTIVE)
    d_x = a[None, :] * d_h + c[None, :] * away + d[None, :]
    tl.store(out + at, d_x.to(out.dtype.element_ty), mask=here)


@triton.jit
@no_type_check
def _of_h(gradient, here, h, ACTIVE: tl.constexpr):
    """h's gradient, of the output's."""
    d_h = tl.load(gradient, mask=here, other=0.0).to(tl.float32)
    if ACTIVE:
        share = tl.sigmoid(h)
        d_h *= share * (1 + h * (1 - share))
    return d_h
