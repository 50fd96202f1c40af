"""The decoder's hidden layer on texels: it is linear, as interpolation is, so that it may as well come first."""

import torch
import torch.nn.functional as F
import triton
from jaxtyping import Float
from torch import Tensor

from nerfdiff.utils.precision import full_precision

MOST = 2.0**14
"""Largest texel in fp16: three of them are summed, and no more than 65504 can be."""


def hidden_texels(
    planes: Float[Tensor, "scenes 3 channels height width"],
    w1: Float[Tensor, "*decoders hidden channels"],
    b1: Float[Tensor, "*decoders hidden"],
    half: bool,
) -> Float[Tensor, "scenes 3 height width padded"]:
    """Texels after the hidden layer, before its activation; hidden units padded with zeros to a power of two.

    A point's weights add up to 1 in each plane: each brings a third of the bias.
    """
    scenes, _, channels, height, width = planes.shape
    more = max(16, triton.next_power_of_2(w1.shape[-2])) - w1.shape[-2]
    weight = F.pad(w1.float(), (0, 0, 0, more)).expand(scenes, -1, channels).repeat_interleave(3, 0)
    bias = F.pad(b1.float(), (0, more)).expand(scenes, -1).repeat_interleave(3, 0) / 3
    with full_precision(planes.device):
        table = torch.baddbmm(bias[:, None], planes.float().flatten(0, 1).flatten(2).mT, weight.mT)
    if half:
        table = table.clamp_(-MOST, MOST).half()
    return table.reshape(scenes, 3, height, width, -1)


def texel_gradients(
    d_table: Float[Tensor, "scenes 3 height width padded"],
    planes: Float[Tensor, "scenes 3 channels height width"],
    w1: Float[Tensor, "*decoders hidden channels"],
    with_planes: bool,
    with_layer: bool,
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Compute gradients of planes, w1 and b1, where asked for.

    Args:
        d_table: the table's, its units in `apart`'s order.
    """
    scenes, hidden, padded = len(planes), w1.shape[-2], d_table.shape[-1]
    d_planes = d_w1 = d_b1 = None
    with full_precision(planes.device):
        if with_planes:
            weight = apart(F.pad(w1.float(), (0, 0, 0, padded - hidden)))
            weight = weight.expand(scenes, *weight.shape[-2:]).repeat_interleave(3, 0)
            d_planes = torch.bmm(weight.mT, d_table.flatten(0, 1).flatten(1, 2).mT).reshape(planes.shape)
        if with_layer:
            # row by row, so that many small products fill a GPU where one for each plane would not
            d_w1 = torch.matmul(planes.float().transpose(2, 3), d_table).sum((1, 2)).mT
            d_w1, d_b1 = (together(d)[:, :hidden] for d in (d_w1, d_table.sum((1, 2, 3))[..., None] / 3))
            d_b1 = d_b1[..., 0]
            if w1.ndim == 2:
                d_w1, d_b1 = d_w1.sum(0), d_b1.sum(0)
    return d_planes, d_w1, d_b1


def apart(units: Float[Tensor, "*scenes padded numbers"]) -> Float[Tensor, "*scenes padded numbers"]:
    """Units 0 to 3, 8 to 11, … and then the others: the order in which kernels add up gradients."""
    return units.unflatten(-2, (-1, 2, 4)).transpose(-4, -3).flatten(-4, -2)


def together(units: Float[Tensor, "*scenes padded numbers"]) -> Float[Tensor, "*scenes padded numbers"]:
    """The inverse of `apart`."""
    return units.unflatten(-2, (2, -1, 4)).transpose(-4, -3).flatten(-4, -2)
