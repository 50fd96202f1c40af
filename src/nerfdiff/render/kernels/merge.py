"""Importance samples by inverse CDF, merged with the uniform ones: no sort, since both come in order."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.samples import uniform_distance


@triton.jit(do_not_specialize=["n", "first", "count"])
@no_type_check
def merge_kernel(
    weights, near, far, jitter, distances, n, first, count, samples, drawn, jitters, floor,
    JITTER: tl.constexpr, EVEN: tl.constexpr, DP: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """Ascending distances [scenes, count, samples + drawn] from weights [scenes, count, samples].

    As `importance_distances` over `edges_between` of the uniform samples; EVEN: over equal bins, of which the weights
    were found without jitter. DP pads `drawn`.
    """
    scene = tl.program_id(1).to(tl.int64)
    ray = tl.program_id(0) * R + tl.arange(0, R)
    here = ray < count
    at = scene * n + first + ray
    low = tl.load(near + at, mask=here, other=0.0)
    end = tl.load(far + at, mask=here, other=0.0)
    extent = end - low
    ray_jitter = jitter + at * jitters
    found = weights + (scene * count + ray) * samples

    total = tl.zeros([R], tl.float32)
    for i in range(0, samples):
        total += tl.load(found + i, mask=here, other=0.0).to(tl.float32)
    hit = total > 1e-8
    inverse = 1.0 / tl.where(hit, total, 1.0)
    even = 1.0 / samples

    j = tl.arange(0, DP)[None, :]
    taken = here[:, None] & (j < drawn)
    if JITTER:
        offset = tl.load(ray_jitter[:, None] + samples + j, mask=taken, other=0.5)
        # in [0, 1] the quantiles ascend, and so do the distances: ranks below are then a permutation
        offset = tl.minimum(tl.maximum(offset, 0.0), 1.0)
    else:
        offset = 0.5
    quantile = (j + offset) / drawn + tl.zeros([R, DP], tl.float32)

    picked = tl.zeros([R, DP], tl.float32) + end[:, None]
    below = tl.zeros([R], tl.float32)
    edge = low
    centre = uniform_distance(low, extent, 0, samples, ray_jitter, here, JITTER)
    for i in range(0, samples):
        after = uniform_distance(low, extent, i + 1, samples, ray_jitter, here & (i + 1 < samples), JITTER)
        next_edge = low + extent * ((i + 1) * even) if EVEN else 0.5 * (centre + after)
        next_edge = tl.where(i == samples - 1, end, next_edge)
        share = tl.where(hit, tl.load(found + i, mask=here, other=0.0).to(tl.float32) * inverse, even)
        share = (1.0 - floor) * share + floor * even
        above = below + share
        inside = (quantile >= below[:, None]) & ((quantile < above[:, None]) | (i == samples - 1))
        fraction = tl.minimum((quantile - below[:, None]) * (1.0 / share)[:, None], 1.0)
        place = edge[:, None] + fraction * (next_edge - edge)[:, None]
        picked = tl.where(inside, tl.minimum(place, next_edge[:, None]), picked)
        below, edge, centre = above, next_edge, after

    out = distances + (scene * count + ray) * (samples + drawn)
    rank = j + tl.zeros([R, DP], tl.int32)
    latest = low
    for i in range(0, samples):
        latest = tl.maximum(latest, uniform_distance(low, extent, i, samples, ray_jitter, here, JITTER))
        sooner = (picked < latest[:, None]) & (j < drawn)
        rank += tl.where(sooner, 0, 1)
        tl.store(out + i + tl.sum(sooner.to(tl.int32), 1), latest, mask=here)
    tl.store(out[:, None] + rank, picked, mask=taken)
