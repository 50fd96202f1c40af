"""The backward pass: what a picture's gradient is to planes, decoder and rays. Everything is computed again."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import column, columns, dot, operand, query, scene_field
from nerfdiff.render.kernels.samples import absorbed, around, optical_depth, store_vector, vector
from nerfdiff.render.kernels.spread import add_to_planes, note_cells, slopes


@triton.jit(do_not_specialize=["n", "first", "count", "size_class"])
@no_type_check
def gradient_kernel(
    planes, K, scene_near, scene_far, w1, b1, w2, b2, origins, directions, near, far, distances,
    rgb, opacity, depth, d_rgb, d_opacity, d_depth,
    d_planes, d_decoder, d_origins, d_directions, d_features, cells, fractions,
    image_width, image_height, shift, scale, background, n, first, count, samples, height, width, points, size_class,
    OPAQUE: tl.constexpr, SHARED: tl.constexpr, PRECISION: tl.constexpr, PLANES: tl.constexpr, DECODER: tl.constexpr,
    RAYS: tl.constexpr, C: tl.constexpr, HIDDEN: tl.constexpr, CP: tl.constexpr, HP: tl.constexpr,
    R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Gradients of rays [scenes, first : first + count] of n; a program takes every so manyeth block of R rays.

    PLANES: "atomic" adds to d_planes; "ordered" writes features' gradients, their cells and places in them, to be
    summed in a fixed order; "none". DECODER, RAYS: whether these are asked for. Decoder gradients are each program's
    own sums, added to d_decoder [scenes, programs, HIDDEN · C + HIDDEN + 4 · HIDDEN + 4].

    With w_i = T_i (1 − exp(−o_i)) and g_i = ∂L/∂w_i, ∂L/∂o_i = g_i T_{i+1} − Σ_{j>i} g_j w_j, and the sum over all j
    is known from the picture, so that one walk from front to back is enough.
    """
    scene = tl.program_id(1).to(tl.int64)
    planes, frame, layers = scene_field(
        scene, planes, K, scene_near, scene_far, w1, b1, w2, b2, image_width, image_height, height, width,
        SHARED, PRECISION, C, HIDDEN, CP, HP,
    )  # fmt: skip
    _, inverse_extent, fx, _, fy, _ = frame
    hidden_w, _, output_w, _ = layers
    channel = tl.arange(0, CP)

    # products sum over points: sums over points of columns kept in registers would take most of them
    ones = operand(tl.full([16, R * S], 1.0, tl.float32), PRECISION)
    d_w1 = tl.zeros([CP, HP], tl.float32)
    d_b1 = tl.zeros([16, HP], tl.float32)
    d_w2 = tl.zeros([16, HP], tl.float32)
    d_b2 = tl.zeros([R * S, 16], tl.float32)

    point = tl.arange(0, R * S)
    for block in range(tl.program_id(0), tl.cdiv(count, R), tl.num_programs(0)):
        # every quantity of points lives in a column [R · S], every quantity of compositing in a tile [R, S]
        ray = block * R + point // S
        here = ray < count
        at = scene * n + first + ray
        ox, oy, oz = vector(origins, at, here)
        dx, dy, dz = vector(directions, at, here)
        sample = (scene * count + ray) * samples

        rays = block * R + tl.arange(0, R)
        row = rays < count
        at = scene * n + first + rays
        ray_near = tl.load(near + at, mask=row, other=0.0)
        ray_far = tl.load(far + at, mask=row, other=0.0)
        ray_distances = (distances + (scene * count + rays) * samples)[:, None]
        g_red, g_green, g_blue = vector(d_rgb, at, row)
        total = tl.load(opacity + at, mask=row, other=0.0)
        reached = total > 1e-6
        expected = tl.load(depth + at, mask=row, other=0.0)
        g_depth = tl.load(d_depth + at, mask=row, other=0.0)
        g_depth = tl.where(reached, g_depth / tl.where(reached, total, 1.0), 0.0)
        g_weight = tl.load(d_opacity + at, mask=row, other=0.0)
        seen_red, seen_green, seen_blue = vector(rgb, at, row)
        remaining = g_red * seen_red + g_green * seen_green + g_blue * seen_blue + g_weight * total
        if not OPAQUE:
            g_behind = (g_red + g_green + g_blue) * background
            remaining -= g_behind
            g_weight -= g_behind
        # no weight's gradient is greater: colours are in [0, 1], distances in [near, far]
        most = tl.abs(g_red) + tl.abs(g_green) + tl.abs(g_blue) + tl.abs(g_weight)
        most += tl.abs(g_depth) * (ray_far - ray_near)

        passed = tl.zeros([R], tl.float32)
        g_ox = tl.zeros([R], tl.float32)
        g_oy = tl.zeros([R], tl.float32)
        g_oz = tl.zeros([R], tl.float32)
        g_dx = tl.zeros([R], tl.float32)
        g_dy = tl.zeros([R], tl.float32)
        g_dz = tl.zeros([R], tl.float32)
        for tile in range(0, samples, S):
            i = tile + point % S
            kept = here & (i < samples)
            t = tl.load(distances + sample + i, mask=kept, other=0.0)
            px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
            outputs, density, place, inner = query(
                planes, px, py, pz, frame, layers, shift, scale, height, width, C, CP, PRECISION
            )
            u, v, w, valid = place
            x, pre, gate, hidden = inner
            slope = tl.where(valid, tl.sigmoid(column(outputs, 3) + shift) * scale * inverse_extent, 0.0)
            red = tl.sigmoid(column(outputs, 0))
            green = tl.sigmoid(column(outputs, 1))
            blue = tl.sigmoid(column(outputs, 2))

            s = tile + tl.arange(0, S)[None, :]
            inside, centre, length = around(ray_distances, s, ray_near, ray_far, row, samples)
            optical = optical_depth(tl.reshape(density, [R, S]), length)
            seen = tl.exp(-(passed[:, None] + (tl.cumsum(optical, 1) - optical)))
            weight = tl.where(inside, seen * absorbed(optical), 0.0)
            if OPAQUE:
                weight = tl.where(inside & (s == samples - 1), seen, weight)
            passed += tl.sum(optical, 1)

            g = g_weight[:, None] + g_depth[:, None] * (centre - expected[:, None])
            g += g_red[:, None] * tl.reshape(red, [R, S])
            g += g_green[:, None] * tl.reshape(green, [R, S])
            g += g_blue[:, None] * tl.reshape(blue, [R, S])
            contribution = g * weight
            later = remaining[:, None] - tl.cumsum(contribution, 1)
            remaining -= tl.sum(contribution, 1)
            # What comes later weighs no more than what gets there. The difference alone would leave its rounding
            # errors where nothing does, and steep densities would make them large.
            through = seen * tl.exp(-optical)
            bound = through * most[:, None]
            later = tl.where(later > bound, bound, tl.where(later < -bound, -bound, later))
            g_density = (g * through - later) * length
            if OPAQUE:
                g_density = tl.where(s == samples - 1, 0.0, g_density)

            g_density = tl.reshape(g_density, [R * S]) * slope
            d_red = tl.reshape(weight * g_red[:, None], [R * S]) * red * (1.0 - red)
            d_green = tl.reshape(weight * g_green[:, None], [R * S]) * green * (1.0 - green)
            d_blue = tl.reshape(weight * g_blue[:, None], [R * S]) * blue * (1.0 - blue)
            d_outputs = columns(d_red, d_green, d_blue, g_density)
            d_hidden = dot(operand(d_outputs, PRECISION), tl.trans(output_w), PRECISION)
            d_pre = operand(d_hidden * gate * (1.0 + pre * (1.0 - gate)), PRECISION)

            if DECODER:
                d_w1 += dot(tl.trans(x), d_pre, PRECISION)
                d_b1 += dot(ones, d_pre, PRECISION)
                d_w2 += dot(tl.trans(operand(d_outputs, PRECISION)), hidden, PRECISION)
                d_b2 += d_outputs
            if PLANES != "none" or RAYS:
                d_x = dot(d_pre, tl.trans(hidden_w), PRECISION)
            if PLANES == "atomic":
                # what is hidden or empty has nothing to add; a NaN is no zero and gets through
                kept = kept & ((d_red != 0.0) | (d_green != 0.0) | (d_blue != 0.0) | (g_density != 0.0))
                into = d_planes + scene * 3 * height * width * C
                add_to_planes(into, d_x, kept, u, v, w, height, width, channel, C)
            if PLANES == "ordered":
                tl.store(
                    d_features + (sample + i)[:, None] * C + channel[None, :],
                    d_x,
                    mask=kept[:, None] & (channel[None, :] < C),
                )
                note_cells(cells, fractions, scene, sample + i, kept, u, v, w, height, width, points)
            if RAYS:
                g_u, g_v, g_w = slopes(planes, d_x, u, v, w, height, width, channel, C)
                inverse = 1.0 / tl.where(valid, pz, 1.0)
                g_x = tl.where(valid, g_u * fx * inverse, 0.0)
                g_y = tl.where(valid, g_v * fy * inverse, 0.0)
                g_z = tl.where(valid, g_w * inverse_extent - (g_x * px + g_y * py) * inverse, 0.0)
                g_ox += tl.sum(tl.reshape(g_x, [R, S]), 1)
                g_oy += tl.sum(tl.reshape(g_y, [R, S]), 1)
                g_oz += tl.sum(tl.reshape(g_z, [R, S]), 1)
                g_dx += tl.sum(tl.reshape(g_x * t, [R, S]), 1)
                g_dy += tl.sum(tl.reshape(g_y * t, [R, S]), 1)
                g_dz += tl.sum(tl.reshape(g_z * t, [R, S]), 1)

        if RAYS:
            store_vector(d_origins, at, g_ox, g_oy, g_oz, row)
            store_vector(d_directions, at, g_dx, g_dy, g_dz, row)

    if DECODER:
        out = d_decoder + (scene * tl.num_programs(0) + tl.program_id(0)) * (HIDDEN * C + 5 * HIDDEN + 4)
        unit, k = tl.arange(0, HP), tl.arange(0, 16)
        add_own(out + unit[None, :] * C + channel[:, None], d_w1, (channel[:, None] < C) & (unit[None, :] < HIDDEN))
        out += HIDDEN * C
        add_own(out + unit[None, :] + 0 * k[:, None], d_b1, (unit[None, :] < HIDDEN) & (k[:, None] == 0))
        out += HIDDEN
        add_own(out + k[:, None] * HIDDEN + unit[None, :], d_w2, (unit[None, :] < HIDDEN) & (k[:, None] < 4))
        out += 4 * HIDDEN
        add_own(out + k, tl.sum(d_b2, 0), k < 4)


@triton.jit
@no_type_check
def add_own(at, value, mask):
    """Add to what no other program touches."""
    tl.store(at, tl.load(at, mask=mask, other=0.0) + value, mask=mask)
