"""The picture: colour, opacity and depth of rays at given distances, in one pass."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import (
    column,
    dot,
    features,
    first_layer,
    frustum,
    operand,
    second_layer,
    softplus,
    unit_coordinates,
)
from nerfdiff.render.kernels.samples import absorbed, interval, optical_depth


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
    own = 0 if SHARED else scene
    start, inverse_extent, fx, cx, fy, cy = frustum(scene, K, scene_near, scene_far, image_width, image_height)
    hidden_w, hidden_b = first_layer(w1 + own * HIDDEN * C, b1 + own * HIDDEN, C, HIDDEN, CP, HP)
    output_w, output_b = second_layer(w2 + own * 4 * HIDDEN, b2 + own * 4, HIDDEN, HP)
    hidden_w, output_w = operand(hidden_w, PRECISION), operand(output_w, PRECISION)
    channel = tl.arange(0, CP)
    planes += scene * 3 * height * width * C

    # every quantity of points lives in a column [R · S], every quantity of compositing in a tile [R, S]
    point = tl.arange(0, R * S)
    ray = tl.program_id(0) * R + point // S
    here = ray < count
    at = (scene * n + first + ray) * 3
    ox = tl.load(origins + at, mask=here, other=0.0)
    oy = tl.load(origins + at + 1, mask=here, other=0.0)
    oz = tl.load(origins + at + 2, mask=here, other=0.0)
    dx = tl.load(directions + at, mask=here, other=0.0)
    dy = tl.load(directions + at + 1, mask=here, other=0.0)
    dz = tl.load(directions + at + 2, mask=here, other=0.0)
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
        u, v, w, valid = unit_coordinates(ox + t * dx, oy + t * dy, oz + t * dz, start, inverse_extent, fx, cx, fy, cy)
        x = features(planes, u, v, w, height, width, channel, C)
        pre = dot(operand(x, PRECISION), hidden_w, PRECISION) + hidden_b[None, :]
        outputs = dot(operand(pre * tl.sigmoid(pre), PRECISION), output_w, PRECISION) + output_b[None, :]
        density = tl.where(valid, softplus(column(outputs, 3) + shift) * scale * inverse_extent, 0.0)

        i = tile + tl.arange(0, S)[None, :]
        inside = row[:, None] & (i < samples)
        before = tl.load(ray_distances + i - 1, mask=inside & (i > 0), other=0.0)
        centre = tl.load(ray_distances + i, mask=inside, other=0.0)
        after = tl.load(ray_distances + i + 1, mask=row[:, None] & (i + 1 < samples), other=0.0)
        length = interval(before, centre, after, ray_near[:, None], ray_far[:, None], i, samples - 1)
        optical = optical_depth(tl.reshape(density, [R, S]), tl.where(inside, length, 0.0))
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
    tl.store(rgb + at * 3, red + behind, mask=row)
    tl.store(rgb + at * 3 + 1, green + behind, mask=row)
    tl.store(rgb + at * 3 + 2, blue + behind, mask=row)
    tl.store(opacity + at, total, mask=row)
    reached = total > 1e-6
    tl.store(depth + at, tl.where(reached, reach / tl.where(reached, total, 1.0), ray_far), mask=row)
