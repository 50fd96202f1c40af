"""Gradients of planes summed in a fixed order: points are sorted by cell, and each texel reads the four around it."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor


@triton.jit
@no_type_check
def cells_kernel(
    d_planes, d_features, fractions, order, starts, height, width, points,
    C: tl.constexpr, CP: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Add to one texel per program what the points around it gave, P at a time, in the order they were sorted."""
    texel = tl.program_id(0).to(tl.int64)
    row, column = (texel // width) % height, texel % width
    channel, lane = tl.arange(0, CP), tl.arange(0, P)
    total = tl.zeros([CP], tl.float32)
    for side in tl.static_range(4):
        back_row, back_column = side // 2, side % 2
        exists = (row >= back_row) & (column >= back_column)
        cell = tl.where(exists, texel - back_row * width - back_column, texel)
        begin = tl.load(starts + cell)
        end = tl.where(exists, tl.load(starts + cell + 1), begin)
        for first in range(begin, end, P):
            inside = first + lane < end
            entry = tl.load(order + first + lane, mask=inside, other=0)
            fr = tl.load(fractions + entry * 2, mask=inside, other=0.0)
            fc = tl.load(fractions + entry * 2 + 1, mask=inside, other=0.0)
            share = (fr if back_row else 1.0 - fr) * (fc if back_column else 1.0 - fc)
            at = (entry % points)[:, None] * C + channel[None, :]
            value = tl.load(d_features + at, mask=inside[:, None] & (channel[None, :] < C), other=0.0)
            total += tl.sum(value * tl.where(inside, share, 0.0)[:, None], 0)
    at = d_planes + texel * C + channel
    tl.store(at, tl.load(at, mask=channel < C, other=0.0) + total, mask=channel < C)


def add_cells(d_planes: Tensor, d_features: Tensor, cells: Tensor, fractions: Tensor) -> None:
    """Add to planes [scenes, 3, height, width, channels] the gradients of features [points, channels].

    Args:
        cells: the flat index of the texel before each point, on each plane: int32 [3, points].
        fractions: how far behind that texel the point is, (row, column): [3, points, 2].
    """
    _, _, height, width, channels = d_planes.shape
    texels = d_planes.numel() // channels
    keys, order = torch.sort(cells.flatten(), stable=True)
    starts = torch.searchsorted(keys, torch.arange(texels + 1, dtype=keys.dtype, device=keys.device))
    cells_kernel[(texels,)](
        d_planes, d_features, fractions, order, starts, height, width, len(d_features),
        C=channels, CP=max(16, triton.next_power_of_2(channels)), P=16, num_warps=1,
    )  # fmt: skip
