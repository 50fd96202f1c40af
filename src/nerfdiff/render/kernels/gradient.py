"""The backward pass of a field: from gradients of the output layer's numbers to texels, output layer and rays."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import activated, cell, corners, gathered, places, project, scene_field
from nerfdiff.render.kernels.samples import four, store_vector, vector


@triton.jit(do_not_specialize=["n", "first", "count", "samples", "segment", "points", "size_class"])
@no_type_check
def gradient_kernel(
    table, K, scene_near, scene_far, w2, b2, origins, directions, distances, d_values,
    d_table, d_w2, d_origins, d_directions, d_features, cells, fractions,
    image_width, image_height, n, first, count, samples, segment, points, size_class,
    TABLE: tl.constexpr, RUNS: tl.constexpr, DECODER: tl.constexpr, RAYS: tl.constexpr, SHARED: tl.constexpr,
    HALF: tl.constexpr, HIDDEN: tl.constexpr, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """Gradients of rays [scenes, first : first + count] of n, from d_values [scenes, count, samples, 4].

    A program takes every so manyeth piece of R rays and `segment` samples (all, where RAYS).
    TABLE: "atomic" adds to d_table, RUNS: not before a ray leaves a cell; "ordered" writes features' gradients, their
    cells and places in them, to be summed in a fixed order; "none". DECODER, RAYS: whether the output layer's weights
    and rays are asked for. The former are each program's own sums, added to d_w2 [scenes, programs, 4, HP].
    """
    scene = tl.program_id(1).to(tl.int64)
    table, frame, weights, _ = scene_field(
        scene, table, K, scene_near, scene_far, w2, b2, image_width, image_height, SHARED, HIDDEN, HP, H, W
    )
    d_table += scene * 3 * H * W * HP
    _, inverse_extent, fx, _, fy, _ = frame
    d_red_w = tl.zeros([R, HP], tl.float32)
    d_green_w = tl.zeros([R, HP], tl.float32)
    d_blue_w = tl.zeros([R, HP], tl.float32)
    d_density_w = tl.zeros([R, HP], tl.float32)

    pieces = tl.cdiv(samples, segment)
    for piece in range(tl.program_id(0), tl.cdiv(count, R) * pieces, tl.num_programs(0)):
        ray = piece // pieces * R + tl.arange(0, R)
        here = ray < count
        at = scene * n + first + ray
        ox, oy, oz = vector(origins, at, here)
        dx, dy, dz = vector(directions, at, here)
        row = (scene * count + ray) * samples
        begin = piece % pieces * segment
        g_ox = tl.zeros([R], tl.float32)
        g_oy = tl.zeros([R], tl.float32)
        g_oz = tl.zeros([R], tl.float32)
        g_dx = tl.zeros([R], tl.float32)
        g_dy = tl.zeros([R], tl.float32)
        g_dz = tl.zeros([R], tl.float32)
        runs = (nowhere(R, HP), nowhere(R, HP), nowhere(R, HP)) if RUNS else (0, 0, 0)
        for i in range(begin, tl.minimum(begin + segment, samples)):
            d_red, d_green, d_blue, d_density = four(d_values, row + i, here)
            # what is hidden or empty has nothing to add; a NaN is no zero and gets through
            kept = (d_red != 0.0) | (d_green != 0.0) | (d_blue != 0.0) | (d_density != 0.0)
            if (TABLE == "ordered") or (tl.max(kept.to(tl.int32), 0) > 0):
                t = tl.load(distances + row + i, mask=here, other=0.0)
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                u, v, w, inverse, valid = project(frame, x, y, z)
                where = places(u, v, w, valid, H, W)
                pre = gathered(table, where, HP, H, W, HALF)
                hidden, gate = activated(pre, HALF)
                if DECODER:
                    d_red_w += d_red[:, None] * hidden
                    d_green_w += d_green[:, None] * hidden
                    d_blue_w += d_blue[:, None] * hidden
                    d_density_w += d_density[:, None] * hidden
                d_pre = d_red[:, None] * weights[0][None, :] + d_green[:, None] * weights[1][None, :]
                d_pre += d_blue[:, None] * weights[2][None, :] + d_density[:, None] * weights[3][None, :]
                d_pre *= gate + hidden * (1.0 - gate)
                if TABLE == "atomic":
                    if RUNS:
                        runs = (
                            onward(d_table, runs[0], d_pre, 0, where[0], HP, H, W),
                            onward(d_table, runs[1], d_pre, 1, where[1], HP, H, W),
                            onward(d_table, runs[2], d_pre, 2, where[2], HP, H, W),
                        )
                    else:
                        for plane in tl.static_range(3):
                            add_cell(d_table, shared(d_pre, plane, where[plane], H, W), kept, HP, H, W)
                if TABLE == "ordered":
                    even, odd = halves(d_pre)
                    half = d_features + (row + i)[:, None] * HP + tl.arange(0, HP // 2)[None, :]
                    tl.store(half, even, mask=here[:, None])
                    tl.store(half + HP // 2, odd, mask=here[:, None])
                    note_cells(cells, fractions, scene, row + i, here, where, points, H, W)
                if RAYS:
                    g_u, g_v, g_w = slopes(table, d_pre, where, HP, H, W)
                    g_x = tl.where(valid, g_u * fx * inverse, 0.0)
                    g_y = tl.where(valid, g_v * fy * inverse, 0.0)
                    g_z = tl.where(valid, g_w * inverse_extent - (g_x * x + g_y * y) * inverse, 0.0)
                    g_ox += g_x
                    g_oy += g_y
                    g_oz += g_z
                    g_dx += g_x * t
                    g_dy += g_y * t
                    g_dz += g_z * t
        if RUNS and TABLE == "atomic":
            for plane in tl.static_range(3):
                add_cell(d_table, runs[plane], runs[plane][0] >= 0, HP, H, W)
        if RAYS:
            store_vector(d_origins, at, g_ox, g_oy, g_oz, here)
            store_vector(d_directions, at, g_dx, g_dy, g_dz, here)

    if DECODER:
        out = d_w2 + (scene * tl.num_programs(0) + tl.program_id(0)) * 4 * HP + tl.arange(0, HP)
        add_own(out, tl.sum(d_red_w, 0))
        add_own(out + HP, tl.sum(d_green_w, 0))
        add_own(out + 2 * HP, tl.sum(d_blue_w, 0))
        add_own(out + 3 * HP, tl.sum(d_density_w, 0))


@triton.jit
@no_type_check
def add_own(at, value):
    """Add to what no other program touches."""
    tl.store(at, tl.load(at) + value)


@triton.jit
@no_type_check
def nowhere(R: tl.constexpr, HP: tl.constexpr):
    """A run in no cell."""
    none = tl.zeros([R, HP], tl.float32)
    return tl.full([R], -1, tl.int32), none, none, none, none


@triton.jit
@no_type_check
def shared(d_pre, PLANE: tl.constexpr, place, H: tl.constexpr, W: tl.constexpr):
    """A cell, and what its corners get of the gradients of the hidden layer."""
    w00, w01, w10, w11 = corners(*place)
    of_corners = d_pre * w00[:, None], d_pre * w01[:, None], d_pre * w10[:, None], d_pre * w11[:, None]
    return cell(PLANE, place, H, W), of_corners[0], of_corners[1], of_corners[2], of_corners[3]


@triton.jit
@no_type_check
def onward(d_table, run, d_pre, PLANE: tl.constexpr, place, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr):
    """A run, what the corners of one cell got, a sample further: where that is in another cell, it is added."""
    left = run[0] != cell(PLANE, place, H, W)
    if tl.max(left.to(tl.int32), 0) > 0:
        add_cell(d_table, run, left & (run[0] >= 0), HP, H, W)
    same = tl.where(left, 0.0, 1.0)[:, None]
    share = shared(d_pre, PLANE, place, H, W)
    return (
        share[0],
        run[1] * same + share[1],
        run[2] * same + share[2],
        run[3] * same + share[3],
        run[4] * same + share[4],
    )


@triton.jit
@no_type_check
def add_cell(d_table, share, kept, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr):
    """Add to a cell's corners, by atomic additions: in no fixed order."""
    right: tl.constexpr = HP if W > 1 else 0
    below: tl.constexpr = W * HP if H > 1 else 0
    mask = kept[:, None] & (tl.arange(0, HP // 2) >= 0)[None, :]  # the interpreter's atomics take no broadcast masks
    at = d_table + (share[0] * HP)[:, None] + tl.arange(0, HP // 2)[None, :]
    for half in tl.static_range(2):
        tl.atomic_add(at + half * (HP // 2), halves(share[1])[half], mask=mask, sem="relaxed")
        tl.atomic_add(at + (half * (HP // 2) + right), halves(share[2])[half], mask=mask, sem="relaxed")
        tl.atomic_add(at + (half * (HP // 2) + below), halves(share[3])[half], mask=mask, sem="relaxed")
        tl.atomic_add(at + (half * (HP // 2) + below + right), halves(share[4])[half], mask=mask, sem="relaxed")


@triton.jit
@no_type_check
def halves(d_pre):
    """Units 0 to 3, 8 to 11, … and the others: a thread has 8 units, and adds 4 numbers at once."""
    apart = tl.reshape(d_pre, [d_pre.shape[0], d_pre.shape[1] // 8, 2, 4])
    even, odd = tl.split(tl.permute(apart, [0, 1, 3, 2]))
    shape: tl.constexpr = [d_pre.shape[0], d_pre.shape[1] // 2]
    return tl.reshape(even, shape), tl.reshape(odd, shape)


@triton.jit
@no_type_check
def note_cells(cells, fractions, scene, point, here, places, points, H: tl.constexpr, W: tl.constexpr):
    """Write the cell [3, points] each point is in on each plane, and where in it [3, points, 2] (row, column)."""
    for plane in tl.static_range(3):
        entry = plane * points + point
        index = scene * 3 * H * W + cell(plane, places[plane], H, W)
        tl.store(cells + entry, index.to(tl.int32), mask=here)
        tl.store(fractions + entry * 2, places[plane][0][1], mask=here)
        tl.store(fractions + entry * 2 + 1, places[plane][1][1], mask=here)


@triton.jit
@no_type_check
def slopes(table, d_pre, places, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr):
    """Gradients of unit coordinates, from those of the hidden layer: zero where borders repeat."""
    right: tl.constexpr = HP if W > 1 else 0
    below: tl.constexpr = W * HP if H > 1 else 0
    zero = tl.zeros([d_pre.shape[0]], tl.float32)
    g_u, g_v, g_w = zero, zero, zero
    for plane in tl.static_range(3):
        row, column = places[plane]
        at = table + (cell(plane, places[plane], H, W) * HP)[:, None] + tl.arange(0, HP)[None, :]
        v00, v01 = tl.load(at).to(tl.float32), tl.load(at + right).to(tl.float32)
        v10, v11 = tl.load(at + below).to(tl.float32), tl.load(at + (below + right)).to(tl.float32)
        g_column = (v01 - v00) * (1.0 - row[1])[:, None] + (v11 - v10) * row[1][:, None]
        g_row = (v10 - v00) * (1.0 - column[1])[:, None] + (v11 - v01) * column[1][:, None]
        g_column = tl.where(column[2], tl.sum(g_column * d_pre, 1) * W, 0.0)
        g_row = tl.where(row[2], tl.sum(g_row * d_pre, 1) * H, 0.0)
        if plane == 0:
            g_u, g_v = g_u + g_column, g_v + g_row
        elif plane == 1:
            g_u, g_w = g_u + g_column, g_w + g_row
        else:
            g_w, g_v = g_w + g_column, g_v + g_row
    return g_u, g_v, g_w
