"""The first look along rays: weights ω of uniform samples, which tell where to look again."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import query, scene_field
from nerfdiff.render.kernels.samples import absorbed, interval, optical_depth, uniform_distance, vector


@triton.jit(do_not_specialize=["n", "first", "count", "size_class"])
@no_type_check
def coarse_kernel(
    planes, K, scene_near, scene_far, w1, b1, w2, b2, origins, directions, near, far, jitter, weights,
    image_width, image_height, shift, scale, n, first, count, samples, jitters, height, width, size_class,
    JITTER: tl.constexpr, SHARED: tl.constexpr, PRECISION: tl.constexpr, C: tl.constexpr, HIDDEN: tl.constexpr,
    CP: tl.constexpr, HP: tl.constexpr, R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Weights [scenes, count, samples] of rays [scenes, first : first + count] of n; R rays per program."""
    scene = tl.program_id(1).to(tl.int64)
    planes, frame, layers = scene_field(
        scene, planes, K, scene_near, scene_far, w1, b1, w2, b2, image_width, image_height, height, width,
        SHARED, PRECISION, C, HIDDEN, CP, HP,
    )  # fmt: skip

    # every quantity of points lives in a column [R · S], every quantity of compositing in a tile [R, S]
    point = tl.arange(0, R * S)
    ray = tl.program_id(0) * R + point // S
    here = ray < count
    at = scene * n + first + ray
    ox, oy, oz = vector(origins, at, here)
    dx, dy, dz = vector(directions, at, here)
    low = tl.load(near + at, mask=here, other=0.0)
    extent = tl.load(far + at, mask=here, other=0.0) - low
    point_jitter = jitter + at * jitters

    rays = tl.program_id(0) * R + tl.arange(0, R)
    rows = (rays < count)[:, None]
    at = scene * n + first + rays
    ray_low = tl.load(near + at, mask=rays < count, other=0.0)[:, None]
    ray_far = tl.load(far + at, mask=rays < count, other=0.0)[:, None]
    ray_extent = ray_far - ray_low
    ray_jitter = (jitter + at * jitters)[:, None]
    out = (weights + (scene * count + rays) * samples)[:, None]

    passed = tl.zeros([R], tl.float32)
    for tile in range(0, samples, S):
        i = tile + point % S
        t = uniform_distance(low, extent, i, samples, point_jitter, here & (i < samples), JITTER)
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        _, density, _, _ = query(planes, x, y, z, frame, layers, shift, scale, height, width, C, CP, PRECISION)

        i = tile + tl.arange(0, S)[None, :]
        inside = rows & (i < samples)
        before = uniform_distance(ray_low, ray_extent, i - 1, samples, ray_jitter, inside & (i > 0), JITTER)
        centre = uniform_distance(ray_low, ray_extent, i, samples, ray_jitter, inside, JITTER)
        after = uniform_distance(ray_low, ray_extent, i + 1, samples, ray_jitter, rows & (i + 1 < samples), JITTER)
        length = interval(before, centre, after, ray_low, ray_far, i, samples - 1)
        optical = optical_depth(tl.reshape(density, [R, S]), tl.where(inside, length, 0.0))
        until = passed[:, None] + (tl.cumsum(optical, 1) - optical)
        tl.store(out + i, tl.exp(-until) * absorbed(optical), mask=inside)
        passed += tl.sum(optical, 1)
