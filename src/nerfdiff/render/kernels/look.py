"""Colour and density along rays: of uniform samples, from the eye on, then of those drawn."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import exponential, query, scene_field
from nerfdiff.render.kernels.samples import store_four, uniform_distance, vector


@triton.jit(do_not_specialize=["n", "first", "count", "uniform", "samples", "jitters", "segment", "size_class"])
@no_type_check
def look_kernel(
    table, K, scene_near, scene_far, w2, b2, origins, directions, near, far, jitter,
    distances, values, cumulative, stops,
    image_width, image_height, shift, scale, bound, n, first, count, uniform, samples, jitters, segment, size_class,
    FIRST: tl.constexpr, STOP: tl.constexpr, JITTER: tl.constexpr, SHARED: tl.constexpr, HALF: tl.constexpr,
    HIDDEN: tl.constexpr, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr, R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Rays [scenes, first : first + count] of n, R per program, of each `segment` samples, S at a time.

    FIRST: the uniform samples, all in one segment. Weights are summed in cumulative [scenes, count, uniform], and
    `stops` [scenes, count] tells behind which distance less than `bound` of the light gets. Otherwise the samples that
    follow them in distances [scenes, count, samples]. STOP: what lies behind `stops` is not looked at.
    Values are red, green, blue and density [scenes, count, samples, 4].
    """
    scene = tl.program_id(1).to(tl.int64)
    table, frame, weights, biases = scene_field(
        scene, table, K, scene_near, scene_far, w2, b2, image_width, image_height, SHARED, HIDDEN, HP, H, W
    )
    ray = tl.program_id(0) * R + tl.arange(0, R)
    here = ray < count
    at = scene * n + first + ray
    ox, oy, oz = vector(origins, at, here)
    dx, dy, dz = vector(directions, at, here)
    row = scene * count + ray
    stop = tl.full([R], float("inf"), tl.float32)
    if FIRST:
        low = tl.load(near + at, mask=here, other=0.0)
        end = tl.load(far + at, mask=here, other=0.0)
        extent = end - low
        jitter += at * jitters
        begin, finish = 0, uniform
        edge = low
        t = uniform_distance(low, extent, 0, uniform, jitter, here, JITTER)
        passed = tl.full([R], 1.0, tl.float32)
        total = tl.zeros([R], tl.float32)
    else:
        begin = uniform + tl.program_id(2) * segment
        finish = tl.minimum(begin + segment, samples)
        if STOP:
            stop = tl.load(stops + row, mask=here, other=0.0)

    i = begin
    going = i < finish
    while going:
        for _ in tl.static_range(S):
            inside = here & (i < finish)
            if not FIRST:
                t = tl.load(distances + row * samples + i, mask=inside, other=0.0)
            if STOP:
                inside = inside & (t <= stop)
            red, green, blue, density = query(
                table, frame, weights, biases, ox + t * dx, oy + t * dy, oz + t * dz, shift, scale, HP, H, W, HALF
            )
            store_four(values, row * samples + i, red, green, blue, density, inside)
            if FIRST:
                after = uniform_distance(low, extent, i + 1, uniform, jitter, here & (i + 1 < uniform), JITTER)
                next_edge = tl.where(i == uniform - 1, end, 0.5 * (t + after))
                left = passed * exponential(-density * (next_edge - edge))
                if STOP:
                    left = tl.where(t <= stop, left, passed)
                    stop = tl.where((left < bound) & (passed >= bound), next_edge, stop)
                total += passed - left
                tl.store(cumulative + row * uniform + i, total, mask=here & (i < uniform))
                passed, edge, t = left, next_edge, after
            i += 1
        going = i < finish
        if STOP:
            seen = passed >= bound if FIRST else inside
            going = going & (tl.max((here & seen).to(tl.int32), 0) > 0)
    if STOP and FIRST:
        tl.store(stops + row, stop, mask=here)
        for rest in range(i, uniform):
            tl.store(cumulative + row * uniform + rest, total, mask=here)
