"""The picture: colour, opacity and depth of rays at given distances, in one pass."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import column, query, scene_field
from nerfdiff.render.kernels.samples import absorbed, around, optical_depth, store_vector, vector


@triton.jit(do_not_specialize=["n", "first", "count", "size_class"])
@no_type_check
def composite_kernel(
    planes, K, scene_near, scene_far, w1, b1, w2, b2, origins, directions, near, far, distances,
    rgb, opacity, depth,
    image_width, image_height, shift, scale, background, n, first, count, samples, height, width, size_class,
    OPAQUE: tl.constexpr, SHARED: tl.constexpr, PRECISION: tl.constexpr, C: tl.constexpr, HIDDEN: tl.constexpr,
    CP: tl.constexpr, HP: tl.constexpr, R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Rays [scenes, first : first + count] of n at distances [scenes, count, samples]; R rays per program.

    OPAQUE: the last sample lets nothing through, in place of a background.
    """
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
    point_distances = distances + (scene * count + ray) * samples

    rays = tl.program_id(0) * R + tl.arange(0, R)
    row = rays < count
    at = scene * n + first + rays
    ray_near = tl.load(near + at, mask=row, other=0.0)
    ray_far = tl.load(far + at, mask=row, other=0.0)
    ray_distances = (distances + (scene * count + rays) * samples)[:, None]

    passed = tl.zeros([R], tl.float32)
    total = tl.zeros([R], tl.float32)
    reach = tl.zeros([R], tl.float32)
    red = tl.zeros([R], tl.float32)
    green = tl.zeros([R], tl.float32)
    blue = tl.zeros([R], tl.float32)
    for tile in range(0, samples, S):
        i = tile + point % S
        t = tl.load(point_distances + i, mask=here & (i < samples), other=0.0)
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        outputs, density, _, _ = query(planes, x, y, z, frame, layers, shift, scale, height, width, C, CP, PRECISION)

        i = tile + tl.arange(0, S)[None, :]
        inside, centre, length = around(ray_distances, i, ray_near, ray_far, row, samples)
        optical = optical_depth(tl.reshape(density, [R, S]), length)
        until = passed[:, None] + (tl.cumsum(optical, 1) - optical)
        share = absorbed(optical)
        if OPAQUE:
            share = tl.where(i == samples - 1, 1.0, share)
        weight = tl.where(inside, tl.exp(-until) * share, 0.0)
        passed += tl.sum(optical, 1)
        total += tl.sum(weight, 1)
        reach += tl.sum(weight * centre, 1)
        red += tl.sum(weight * tl.reshape(tl.sigmoid(column(outputs, 0)), [R, S]), 1)
        green += tl.sum(weight * tl.reshape(tl.sigmoid(column(outputs, 1)), [R, S]), 1)
        blue += tl.sum(weight * tl.reshape(tl.sigmoid(column(outputs, 2)), [R, S]), 1)

    behind = 0.0 if OPAQUE else (1.0 - total) * background
    store_vector(rgb, at, red + behind, green + behind, blue + behind, row)
    tl.store(opacity + at, total, mask=row)
    reached = total > 1e-6
    tl.store(depth + at, tl.where(reached, reach / tl.where(reached, total, 1.0), ray_far), mask=row)
