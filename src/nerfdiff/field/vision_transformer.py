"""The vision transformer of VisionNeRF (ViT, arXiv 2010.11929, as in arXiv 2207.05736)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.utils.errors import ConfigError

Tokens = Float[Tensor, "batch tokens width"]


class TransformerBlock(nn.Module):
    """Attention and an MLP, each normalised before and added."""

    def __init__(self, width: int, heads: int, mlp: int):
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width, eps=1e-6)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.attended = nn.Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width, eps=1e-6)
        self.mlp = nn.Sequential(nn.Linear(width, mlp), nn.GELU(), nn.Linear(mlp, width))

    def forward(self, x: Tokens) -> Tokens:
        parts = self.query_key_value(self.norm_attention(x)).chunk(3, dim=-1)
        heads = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        x = x + self.attended(F.scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2))
        return x + self.mlp(self.norm_mlp(x))


class VisionTransformer(nn.Module):
    """Patches of an image as tokens, a class token beside them; tokens are tapped at several depths.

    Args:
        patch: side of a patch, in pixels.
        grid: patches along each side of the images for which the position embedding is made; it is resized, bilinearly,
            for others. Images of other sizes than a multiple of `patch` are resized to the next one.
        width: of a token.
        heads: of attention.
        mlp: hidden width of the blocks' MLPs.
        taps: numbers of the blocks, from 0, whose tokens are given out; there are as many blocks as the last of them
            needs.

    Raises:
        ConfigError: heads do not divide the width, or `taps` are not in order.
    """

    def __init__(self, patch: int, grid: int, width: int, heads: int, mlp: int, taps: Sequence[int]):
        super().__init__()
        if width % heads:
            raise ConfigError(f"model.field.encoder.heads={heads} must divide width={width}")
        if not taps or taps[0] < 0 or list(taps) != sorted(set(taps)):
            raise ConfigError(f"model.field.encoder.taps={list(taps)} must be numbers of blocks, from 0, in order")
        self.patch, self.grid, self.taps = patch, grid, tuple(taps)
        self.patches = nn.Conv2d(3, width, patch, stride=patch)
        self.class_token = nn.Parameter(torch.zeros(1, 1, width))
        self.positions = nn.Parameter(torch.zeros(1, 1 + grid**2, width))
        for embedding in (self.class_token, self.positions):
            nn.init.trunc_normal_(embedding, std=0.02)
        self.blocks = nn.ModuleList(TransformerBlock(width, heads, mlp) for _ in range(taps[-1] + 1))

    def forward(
        self, image: Float[Tensor, "batch 3 height width"]
    ) -> list[tuple[Float[Tensor, "batch channels rows columns"], Float[Tensor, "batch channels"]]]:
        """Return, at each tap, the patches' tokens as a map, and the class token."""
        size = [-(-side // self.patch) * self.patch for side in image.shape[-2:]]
        if size != list(image.shape[-2:]):
            image = F.interpolate(image, size=size, mode="bilinear", align_corners=False)
        embedded = self.patches(image)
        rows, columns = embedded.shape[-2:]
        x = torch.cat([self.class_token.expand(len(image), -1, -1), embedded.flatten(2).mT], 1)
        x = x + self.positions_for(rows, columns)
        tapped = []
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in self.taps:
                tapped.append((x[:, 1:].mT.unflatten(2, (rows, columns)), x[:, 0]))
        return tapped

    def positions_for(self, rows: int, columns: int) -> Float[Tensor, "1 tokens width"]:
        """Resize the position embedding."""
        own, grid = self.positions[:, :1], self.positions[:, 1:].mT.unflatten(2, (self.grid, self.grid))
        if (rows, columns) != (self.grid, self.grid):
            grid = F.interpolate(grid, size=(rows, columns), mode="bilinear", align_corners=False)
        return torch.cat([own, grid.flatten(2).mT], 1)
