"""Device code that takes the gradient of features on to the planes, and to coordinates."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.field import axes, corner, texel


@triton.jit
@no_type_check
def add_to_corner(plane, row, column, width, channel, value, kept, C: tl.constexpr):
    """Add values [points, channels] to one texel per point."""
    at = (row * width + column) * C
    mask = kept[:, None] & (channel[None, :] < C)
    tl.atomic_add(plane + at[:, None] + channel[None, :], value, mask=mask, sem="relaxed")


@triton.jit
@no_type_check
def add_to_planes(planes, d_x, kept, u, v, w, height, width, channel, C: tl.constexpr):
    """Gradients [points, channels] of features, to three planes by atomic additions: in no fixed order."""
    for plane in range(3):
        along_rows, along_columns = axes(plane, u, v, w)
        r0, r1, fr, _ = texel(along_rows, height)
        c0, c1, fc, _ = texel(along_columns, width)
        at = planes + plane * height * width * C
        below, beside = kept & (fr > 0.0), fc > 0.0
        add_to_corner(at, r0, c0, width, channel, d_x * ((1.0 - fr) * (1.0 - fc))[:, None], kept, C)
        add_to_corner(at, r0, c1, width, channel, d_x * ((1.0 - fr) * fc)[:, None], kept & beside, C)
        add_to_corner(at, r1, c0, width, channel, d_x * (fr * (1.0 - fc))[:, None], below, C)
        add_to_corner(at, r1, c1, width, channel, d_x * (fr * fc)[:, None], below & beside, C)


@triton.jit
@no_type_check
def note_cells(cells, fractions, scene, point, kept, u, v, w, height, width, points):
    """Write the cell [3, points] each point is in on each plane, and where in it [3, points, 2] (row, column)."""
    for plane in range(3):
        along_rows, along_columns = axes(plane, u, v, w)
        row, _, fr, _ = texel(along_rows, height)
        column, _, fc, _ = texel(along_columns, width)
        entry = plane * points + point
        tl.store(cells + entry, (((scene * 3 + plane) * height + row) * width + column).to(tl.int32), mask=kept)
        tl.store(fractions + entry * 2, fr, mask=kept)
        tl.store(fractions + entry * 2 + 1, fc, mask=kept)


@triton.jit
@no_type_check
def slopes(planes, d_x, u, v, w, height, width, channel, C: tl.constexpr):
    """Gradients of unit coordinates, from those of features [points, channels]: zero where borders repeat."""
    g_u = tl.zeros_like(u)
    g_v = tl.zeros_like(u)
    g_w = tl.zeros_like(u)
    for plane in range(3):
        along_rows, along_columns = axes(plane, u, v, w)
        r0, r1, fr, rows_slope = texel(along_rows, height)
        c0, c1, fc, columns_slope = texel(along_columns, width)
        at = planes + plane * height * width * C
        v00 = tl.sum(corner(at, r0, c0, width, channel, C) * d_x, 1)
        v01 = tl.sum(corner(at, r0, c1, width, channel, C) * d_x, 1)
        v10 = tl.sum(corner(at, r1, c0, width, channel, C) * d_x, 1)
        v11 = tl.sum(corner(at, r1, c1, width, channel, C) * d_x, 1)
        g_column = tl.where(columns_slope, ((v01 - v00) * (1.0 - fr) + (v11 - v10) * fr) * width, 0.0)
        g_row = tl.where(rows_slope, ((v10 - v00) * (1.0 - fc) + (v11 - v01) * fc) * height, 0.0)
        g_u += tl.where(plane == 2, 0.0, g_column)
        g_v += tl.where(plane == 1, 0.0, g_row)
        g_w += tl.where(plane == 0, 0.0, tl.where(plane == 1, g_row, g_column))
    return g_u, g_v, g_w
