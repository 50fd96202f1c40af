"""The building blocks of the ADM U-Net (Dhariwal & Nichol 2021, arXiv 2105.05233)."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.diffusion.norm_silu import group_norm, norm_silu

Features = Float[Tensor, "batch channels height width"]


def zero(module: nn.Module) -> nn.Module:
    """Zero a layer's parameters, so that a residual branch starts as the identity."""
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    return module


def norm(channels: int) -> nn.GroupNorm:
    """Make ADM's GroupNorm of 32 groups.

    Raises:
        ValueError: channels is not a multiple of 32.
    """
    if channels % 32:
        raise ValueError(f"the U-Net's width must be a multiple of 32 (GroupNorm of 32 groups), got {channels}")
    return nn.GroupNorm(32, channels)


def time_embedding(t: Float[Tensor, "batch"], channels: int) -> Float[Tensor, "batch channels"]:
    """Return a sinusoidal embedding of 1000 t, as DDPM's of integer steps (arXiv 2006.11239)."""
    half = channels // 2
    frequencies = torch.exp(-math.log(10_000) * torch.arange(half, device=t.device) / half)
    angles = 1000 * t.float()[:, None] * frequencies
    return torch.cat([angles.cos(), angles.sin()], -1)


class ResBlock(nn.Module):
    """GroupNorm, SiLU, conv twice, the second norm scaled and shifted by the time embedding if there is one."""

    def __init__(self, channels: int, out_channels: int, embedding: int | None, dropout: float):
        super().__init__()
        self.norm_in = norm(channels)
        self.conv_in = nn.Conv2d(channels, out_channels, 3, padding=1)
        self.embed = None if embedding is None else nn.Linear(embedding, 2 * out_channels)
        self.norm_out = norm(out_channels)
        self.dropout = nn.Dropout(dropout)
        self.conv_out = zero(nn.Conv2d(out_channels, out_channels, 3, padding=1))
        self.skip = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(
        self, x: Features, embedding: Float[Tensor, "batch embedding"] | None
    ) -> Float[Tensor, "batch out_channels height width"]:
        scale_shift = None if self.embed is None else self.embed(F.silu(embedding))
        h = self.conv_in(norm_silu(self.norm_in, x))
        h = norm_silu(self.norm_out, h, scale_shift)
        return self.skip(x) + self.conv_out(self.dropout(h))


class KeyValue(NamedTuple):
    """Keys and values of attention, split into heads; computed once for a context that stays.

    Args:
        key, value: one entry per scene; the images that attend to it may be several views of each.
    """

    key: Float[Tensor, "scenes heads pixels head_channels"]
    value: Float[Tensor, "scenes heads pixels head_channels"]


class Attention(nn.Module):
    """Multi-head attention over pixels: to themselves, or to a context of as many channels.

    Pixels are rows and channels columns, as SDPA's fused kernels ask: the innermost axis must be dense, which a plain
    split of [batch, channels, height, width] does not give (PyTorch then falls back to the kernel that stores all
    attention weights). In channels_last none of the steps from norm to output copies: on a GPU the fused norm keeps the
    layout, on a CPU PyTorch's does.
    """

    def __init__(self, channels: int, head_channels: int, cross: bool):
        super().__init__()
        self.heads = max(1, channels // head_channels)
        self.norm = norm(channels)
        self.norm_context = norm(channels) if cross else None
        self.query = nn.Conv2d(channels, channels, 1)
        self.key_value = nn.Conv2d(channels, 2 * channels, 1)
        self.out = zero(nn.Conv2d(channels, channels, 1))

    def forward(
        self, x: Features, context: Float[Tensor, "scenes channels _h _w"] | KeyValue | None = None
    ) -> Features:
        """Attend from x [scenes · views, …] to the context of each scene, or, without one, of each image to itself.

        Args:
            context: features, or what `keys_values` made of them.
        """
        batch, channels, height, width = x.shape
        h = _rows(group_norm(self.norm, x))
        if self.norm_context is None:
            context = self._split_keys_values(h)
        elif not isinstance(context, KeyValue):
            context = self.keys_values(context)
        # All views of a scene attend to the same context: they are queries of one attention, and nothing is repeated.
        query = _pointwise(self.query, h).reshape(len(context.key), -1, channels)
        attended = F.scaled_dot_product_attention(self._split(query), *context)
        out = _pointwise(self.out, attended.transpose(1, 2).flatten(2))
        return x + out.reshape(batch, height * width, channels).mT.unflatten(2, (height, width))

    def keys_values(self, context: Float[Tensor, "scenes channels _h _w"]) -> KeyValue:
        """Return the keys and values of a context, for `forward` to attend to."""
        return self._split_keys_values(_rows(group_norm(self.norm_context, context)))

    def _split_keys_values(self, rows: Float[Tensor, "scenes pixels channels"]) -> KeyValue:
        return KeyValue(*(self._split(part) for part in _pointwise(self.key_value, rows).chunk(2, dim=-1)))

    def _split(self, rows: Float[Tensor, "batch pixels channels"]) -> Float[Tensor, "batch heads pixels head_channels"]:
        return rows.unflatten(-1, (self.heads, -1)).transpose(1, 2)


def _rows(x: Features) -> Float[Tensor, "batch pixels channels"]:
    return x.flatten(2).mT


def _pointwise(conv: nn.Conv2d, rows: Float[Tensor, "batch pixels channels"]) -> Float[Tensor, "batch pixels out"]:
    """Apply a 1 x 1 convolution to pixels that are rows."""
    return F.linear(rows, conv.weight.flatten(1), conv.bias)


class Downsample(nn.Module):
    """Strided convolution: halves the resolution, rounding up."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, stride=2, padding=1)

    def forward(self, x: Features) -> Float[Tensor, "batch channels (height+1)//2 (width+1)//2"]:
        return self.conv(x)


class Upsample(nn.Module):
    """Nearest-neighbour upsampling to a given size, then a convolution. The size is an argument because halving
    an odd size rounds up (15 → 8 in images of 120 pixels)."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Features, size: tuple[int, int]) -> Float[Tensor, "batch channels {size[0]} {size[1]}"]:
        # on the CPU, where convolutions are bound by multiplications, this takes half the time (measured)
        if x.device.type == "cpu" and tuple(size) == (2 * x.shape[2], 2 * x.shape[3]):
            return F.conv_transpose2d(x, doubling_kernel(self.conv.weight), self.conv.bias, stride=2, padding=1)
        return self.conv(F.interpolate(x, size=size, mode="nearest"))


def doubling_kernel(weight: Float[Tensor, "out channels 3 3"]) -> Float[Tensor, "channels out 4 4"]:
    """Return the transposed convolution of stride 2 that equals doubling by nearest neighbours, then convolving.

    Under the three taps a, b, c lie two different pixels: for an even output a | b + c, for an odd one a + b | c. So a
    transposed kernel of four taps c, b + c, a + b, a has 4/9 of the multiplications.
    """
    for axis in (2, 3):
        a, b, c = weight.unbind(axis)
        weight = torch.stack([c, b + c, a + b, a], axis)
    return weight.transpose(0, 1)
