"""The building blocks of the ADM U-Net (Dhariwal & Nichol 2021)."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

Features = Float[Tensor, "batch channels height width"]


def zero(module: nn.Module) -> nn.Module:
    """Zero a layer's parameters, so that a residual branch starts as the identity."""
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    return module


def norm(channels: int) -> nn.GroupNorm:
    """ADM's GroupNorm of 32 groups.

    Raises:
        ValueError: channels is not a multiple of 32.
    """
    if channels % 32:
        raise ValueError(f"the U-Net's width must be a multiple of 32 (GroupNorm of 32 groups), got {channels}")
    return nn.GroupNorm(32, channels)


def time_embedding(t: Float[Tensor, "batch"], channels: int) -> Float[Tensor, "batch channels"]:
    """Sinusoidal embedding of 1000 t, as DDPM's of integer steps."""
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
        h = self.conv_in(F.silu(self.norm_in(x)))
        h = self.norm_out(h)
        if self.embed is not None:
            scale, shift = self.embed(F.silu(embedding))[:, :, None, None].chunk(2, dim=1)
            h = h * (1 + scale) + shift
        return self.skip(x) + self.conv_out(self.dropout(F.silu(h)))


class Attention(nn.Module):
    """Multi-head attention over pixels: to themselves, or to a context of as many channels."""

    def __init__(self, channels: int, head_channels: int, cross: bool):
        super().__init__()
        self.heads = max(1, channels // head_channels)
        self.norm = norm(channels)
        self.norm_context = norm(channels) if cross else None
        self.query = nn.Conv2d(channels, channels, 1)
        self.key_value = nn.Conv2d(channels, 2 * channels, 1)
        self.out = zero(nn.Conv2d(channels, channels, 1))

    def forward(self, x: Features, context: Features | None = None) -> Features:
        h = self.norm(x)
        source = h if self.norm_context is None else self.norm_context(context)
        q = self._split(self.query(h))
        k, v = (self._split(part) for part in self.key_value(source).chunk(2, dim=1))
        attended = F.scaled_dot_product_attention(q, k, v)
        return x + self.out(attended.transpose(-1, -2).reshape(x.shape))

    def _split(self, x: Features) -> Float[Tensor, "batch heads pixels head_channels"]:
        batch, channels, height, width = x.shape
        return x.reshape(batch, self.heads, channels // self.heads, height * width).transpose(-1, -2)


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
        return self.conv(F.interpolate(x, size=size, mode="nearest"))
