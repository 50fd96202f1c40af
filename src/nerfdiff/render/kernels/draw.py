"""Importance samples by inverse CDF, behind the uniform ones that they are merged with when they are composited."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.samples import uniform_distance


@triton.jit(do_not_specialize=["n", "first", "count", "uniform", "drawn", "jitters"])
@no_type_check
def draw_kernel(
    given, cumulative, near, far, jitter, distances, n, first, count, uniform, drawn, jitters, floor,
    JITTER: tl.constexpr, EVEN: tl.constexpr, UP: tl.constexpr, DP: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """Distances [scenes, count, uniform + drawn]: uniform samples, then drawn ones, both ascending.

    As `importance_distances` over `edges_between` of the uniform samples, whose weights `cumulative` [scenes, count,
    uniform] sums. EVEN: over equal bins of the weights `given` [scenes, n, uniform], whose sums `cumulative` becomes.
    UP and DP pad `uniform` and `drawn`.
    """
    scene = tl.program_id(1).to(tl.int64)
    ray = tl.program_id(0) * R + tl.arange(0, R)[:, None]
    here = ray < count
    at = scene * n + first + ray
    low = tl.load(near + at, mask=here, other=0.0)
    end = tl.load(far + at, mask=here, other=0.0)
    extent = end - low
    jitter += at * jitters
    row = scene * count + ray
    sums = cumulative + row * uniform
    out = distances + row * (uniform + drawn)

    i = tl.arange(0, UP)[None, :]
    there = here & (i < uniform)
    tl.store(out + i, uniform_distance(low, extent, i, uniform, jitter, there, JITTER), mask=there)
    if EVEN:
        weight = tl.load(given + at * uniform + i, mask=there, other=0.0).to(tl.float32)
        tl.store(sums + i, tl.cumsum(weight, 1), mask=there)
        tl.debug_barrier()  # this program reads them again

    total = tl.load(sums + uniform - 1, mask=here, other=0.0)
    hit = total > 1e-8
    even = 1.0 / uniform
    scale, base = tl.where(hit, (1.0 - floor) / tl.where(hit, total, 1.0), 0.0), tl.where(hit, floor, 1.0) * even

    j = tl.arange(0, DP)[None, :]
    there = here & (j < drawn)
    if JITTER:
        # in [0, 1] the quantiles ascend, and so do the distances
        offset = tl.load(jitter + uniform + j, mask=there, other=0.5)
        offset = tl.minimum(tl.maximum(offset, 0.0), 1.0)
    else:
        offset = 0.5
    quantile = (j + offset) / drawn + tl.zeros([R, DP], tl.float32)
    # in which bin: the last one whose lower edge's share is not above the quantile
    bin = tl.zeros([R, DP], tl.int32)
    step = UP // 2
    while step > 0:
        probe = bin + step
        inside = there & (probe < uniform)
        below = tl.load(sums + probe - 1, mask=inside, other=0.0)
        below = tl.where(hit, below * scale, 0.0) + base * probe
        bin = tl.where(inside & (below <= quantile), probe, bin)
        step //= 2
    inner = bin > 0
    below = tl.load(sums + bin - 1, mask=there & inner, other=0.0)
    above = tl.load(sums + bin, mask=there, other=0.0)
    below = tl.where(hit, below * scale, 0.0) + base * bin
    share = tl.where(hit, above * scale, 0.0) + base * (bin + 1) - below
    fraction = tl.minimum(tl.maximum((quantile - below) / tl.maximum(share, 1e-12), 0.0), 1.0)
    outer = bin + 1 < uniform
    if EVEN:
        lower, upper = low + extent * (bin * even), low + extent * ((bin + 1) * even)
    else:
        own = uniform_distance(low, extent, bin, uniform, jitter, there, JITTER)
        before = uniform_distance(low, extent, bin - 1, uniform, jitter, there & inner, JITTER)
        after = uniform_distance(low, extent, bin + 1, uniform, jitter, there & outer, JITTER)
        lower, upper = 0.5 * (before + own), 0.5 * (own + after)
    lower, upper = tl.where(inner, lower, low), tl.where(outer, upper, end)
    tl.store(out + uniform + j, tl.minimum(lower + fraction * (upper - lower), upper), mask=there)
