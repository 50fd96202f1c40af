"""Device code along rays: distances, weights, and numbers that lie side by side."""

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
def four(values, at, mask):
    """Four numbers of each entry [*, 4], read at once."""
    found = tl.load(values + at[:, None] * 4 + tl.arange(0, 4)[None, :], mask=mask[:, None], other=0.0)
    even, odd = tl.split(tl.reshape(found, [at.shape[0], 2, 2]))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
@no_type_check
def store_four(values, at, first, second, third, fourth, mask):
    """The inverse of `four`."""
    together = tl.join(tl.join(first, third), tl.join(second, fourth))
    together = tl.reshape(together, [at.shape[0], 4])
    tl.store(values + at[:, None] * 4 + tl.arange(0, 4)[None, :], together, mask=mask[:, None])
