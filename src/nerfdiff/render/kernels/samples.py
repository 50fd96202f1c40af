"""Device code along rays: distances, bins and weights of tiles [rays, samples]."""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def uniform_distance(start, extent, i, bins, jitter, mask, JITTER: tl.constexpr):
    """The sample of bin i of `bins`: its centre, or the place jitter picks; never beyond the bin's end."""
    step = 1.0 / bins
    lower, upper = start + extent * (i * step), start + extent * ((i + 1) * step)
    offset = tl.load(jitter + i, mask=mask, other=0.5) if JITTER else 0.5
    return tl.minimum(lower + offset * (upper - lower), tl.maximum(upper, lower))


@triton.jit
@no_type_check
def interval(before, here, after, start, end, i, last):
    """Length of the interval around sample i, between the middles to its neighbours."""
    lower = tl.where(i == 0, start, 0.5 * (before + here))
    upper = tl.where(i == last, end, 0.5 * (here + after))
    return upper - lower


@triton.jit
@no_type_check
def optical_depth(density, length):
    """σδ, cut where nothing gets through any more (e⁻⁴⁰): sums of greater ones would swallow the small ones."""
    optical = density * length
    return tl.where(optical > 40.0, 40.0, optical)


@triton.jit
@no_type_check
def absorbed(optical):
    """1 − e⁻ˣ for x ≥ 0, by its series where the difference would cancel."""
    series = optical * (1.0 - optical * (0.5 - optical * (1.0 / 6 - optical * (1.0 / 24 - optical / 120))))
    return tl.where(optical < 0.1, series, 1.0 - tl.exp(-optical))


@triton.jit
@no_type_check
def vector(values, at, mask):
    """Three numbers of each entry [*, 3]."""
    return (
        tl.load(values + at * 3, mask=mask, other=0.0),
        tl.load(values + at * 3 + 1, mask=mask, other=0.0),
        tl.load(values + at * 3 + 2, mask=mask, other=0.0),
    )


@triton.jit
@no_type_check
def store_vector(values, at, x, y, z, mask):
    """The inverse of `vector`."""
    tl.store(values + at * 3, x, mask=mask)
    tl.store(values + at * 3 + 1, y, mask=mask)
    tl.store(values + at * 3 + 2, z, mask=mask)


@triton.jit
@no_type_check
def around(distances, i, near, far, row, samples):
    """Of samples i of rays: whether they exist, where they are, and the length of the interval around each.

    Args:
        distances: pointers [rays, 1] to each ray's ascending distances.
        near, far, row: of each ray [rays]; `row` tells whether there is one.
    """
    inside = row[:, None] & (i < samples)
    before = tl.load(distances + i - 1, mask=inside & (i > 0), other=0.0)
    centre = tl.load(distances + i, mask=inside, other=0.0)
    after = tl.load(distances + i + 1, mask=row[:, None] & (i + 1 < samples), other=0.0)
    length = interval(before, centre, after, near[:, None], far[:, None], i, samples - 1)
    return inside, centre, tl.where(inside, length, 0.0)
