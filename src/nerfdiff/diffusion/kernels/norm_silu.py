"""GroupNorm, scale, shift and SiLU of images in channels_last, which are read twice and written once."""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def sums_kernel(x, sums, pixels, C: tl.constexpr, CP: tl.constexpr, R: tl.constexpr, STEPS: tl.constexpr):
    """Per channel, sum and sum of squares of x [images, pixels, C] less the image's first pixel, over R · STEPS pixels.

    Less a pixel, as the square of a sum of numbers far from zero leaves little of their variance.

    Args:
        sums: [images, parts, 2, C] in fp32, out.
    """
    image, part = tl.program_id(0).to(tl.int64), tl.program_id(1)
    x += image * pixels * C
    channel = tl.arange(0, CP)
    known = channel < C
    pivot = tl.load(x + channel, mask=known, other=0.0).to(tl.float32)
    first = tl.zeros([CP], tl.float32)
    second = tl.zeros([CP], tl.float32)
    for step in range(STEPS):
        pixel = (part * STEPS + step) * R + tl.arange(0, R)
        here = (pixel < pixels)[:, None] & known[None, :]
        value = tl.load(x + pixel[:, None] * C + channel[None, :], mask=here, other=0.0).to(tl.float32)
        value = tl.where(here, value - pivot[None, :], 0.0)
        first += tl.sum(value, 0)
        second += tl.sum(value * value, 0)
    sums += (image * tl.num_programs(1) + part) * 2 * C
    tl.store(sums + channel, first, mask=known)
    tl.store(sums + C + channel, second, mask=known)


@triton.jit
@no_type_check
def totals(sums, parts, C, channel, known):
    """Load both sums [parts, 2, C] of an image's parts, for each channel."""
    first = tl.zeros(channel.shape, tl.float32)
    second = tl.zeros(channel.shape, tl.float32)
    for part in range(parts):
        first += tl.load(sums + part * 2 * C + channel, mask=known, other=0.0)
        second += tl.load(sums + part * 2 * C + C + channel, mask=known, other=0.0)
    return first, second


@triton.jit
@no_type_check
def coefficients_kernel(
    x, sums, weight, bias, scale_shift, coefficients, pixels, parts, eps,
    MODULATED: tl.constexpr, GROUPS: tl.constexpr, SIZE: tl.constexpr, SP: tl.constexpr,
):  # fmt: skip
    """Compute for each channel its group's mean and 1 / standard deviation, and a and b: norm, scale and shift together
    are a (x − mean) + b.

    Args:
        scale_shift: [images, 2, C], where MODULATED.
        coefficients: [images, 4, C] in fp32, out.
    """
    image = tl.program_id(0).to(tl.int64)
    C = GROUPS * SIZE
    member = tl.arange(0, SP)[None, :]
    channel = tl.arange(0, GROUPS)[:, None] * SIZE + member
    known = (member < SIZE) & (channel < C)
    pivot = tl.load(x + image * pixels * C + channel, mask=known, other=0.0).to(tl.float32)
    first, second = totals(sums + image * parts * 2 * C, parts, C, channel, known)
    count = 1.0 * SIZE * pixels
    mean = (tl.sum(pivot, 1) / SIZE + tl.sum(first, 1) / count)[:, None]
    away = tl.where(known, mean - pivot, 0.0)
    variance = tl.sum(second - 2 * away * first + pixels * away * away, 1) / count
    inverse = (1 / tl.sqrt(tl.maximum(variance, 0.0) + eps))[:, None]
    a = tl.load(weight + channel, mask=known, other=0.0).to(tl.float32) * inverse
    b = tl.load(bias + channel, mask=known, other=0.0).to(tl.float32)
    if MODULATED:
        scale_shift += image * 2 * C
        scale = 1 + tl.load(scale_shift + channel, mask=known, other=0.0).to(tl.float32)
        a *= scale
        b = b * scale + tl.load(scale_shift + C + channel, mask=known, other=0.0).to(tl.float32)
    coefficients += image * 4 * C
    tl.store(coefficients + channel, tl.broadcast_to(mean, [GROUPS, SP]), mask=known)
    tl.store(coefficients + C + channel, tl.broadcast_to(inverse, [GROUPS, SP]), mask=known)
    tl.store(coefficients + 2 * C + channel, a, mask=known)
    tl.store(coefficients + 3 * C + channel, b, mask=known)


@triton.jit
@no_type_check
def apply_kernel(
    x, coefficients, out, pixels, ACTIVE: tl.constexpr, C: tl.constexpr, CP: tl.constexpr, R: tl.constexpr
):
    """a (x − mean) + b for R pixels per program, and where ACTIVE the SiLU of it."""
    image = tl.program_id(0).to(tl.int64)
    channel = tl.arange(0, CP)
    known = channel < C
    coefficients += image * 4 * C
    mean = tl.load(coefficients + channel, mask=known, other=0.0)
    a = tl.load(coefficients + 2 * C + channel, mask=known, other=0.0)
    b = tl.load(coefficients + 3 * C + channel, mask=known, other=0.0)
    pixel = tl.program_id(1) * R + tl.arange(0, R)
    here = (pixel < pixels)[:, None] & known[None, :]
    at = image * pixels * C + pixel[:, None] * C + channel[None, :]
    away = tl.load(x + at, mask=here, other=0.0).to(tl.float32) - mean[None, :]
    h = a[None, :] * away + b[None, :]
    if ACTIVE:
        h = h * tl.sigmoid(h)
    tl.store(out + at, h.to(out.dtype.element_ty), mask=here)
