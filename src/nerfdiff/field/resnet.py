"""Image features of a ResNet, from several of its depths: pixelNeRF's encoder (arXiv 2012.02190, 4.1 and B.1)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock

from nerfdiff.utils.errors import ConfigError


class ResNetPyramid(nn.Module):
    """A ResNet without its head, its levels resized to the first one's resolution and put side by side.

    No weights are downloaded. Without those there is no reason for BatchNorm, where images of a batch depend on each
    other; pixelNeRF's alternative is GroupNorm.

    Args:
        channels: of the first convolution and of each stage after it; pixelNeRF takes the first three of ResNet-34.
        blocks: of two convolutions in each stage.
        stride: of the first convolution.
        pool: halve the resolution once more before the first stage; pixelNeRF does not for images of 64 pixels.
        groups: of GroupNorm.

    Raises:
        ConfigError: stages and their blocks do not match, or channels cannot be split into groups.
    """

    def __init__(self, channels: Sequence[int], blocks: Sequence[int], stride: int, pool: bool, groups: int):
        super().__init__()
        if len(channels) != len(blocks) + 1:
            raise ConfigError(
                f"model.field.encoder.channels={list(channels)} must be one more than blocks={list(blocks)}: the first "
                "is of the convolution before the stages"
            )
        check_groups(groups, channels)
        self.out_channels = sum(channels)
        self.conv = nn.Conv2d(3, channels[0], 7, stride, padding=3, bias=False)
        self.norm = nn.GroupNorm(groups, channels[0])
        self.pool = nn.MaxPool2d(3, 2, padding=1) if pool else nn.Identity()
        self.stages = nn.ModuleList(
            residual_stage(channels[level], channels[level + 1], count, 1 if level == 0 else 2, groups)
            for level, count in enumerate(blocks)
        )
        he_convolutions(self)

    def forward(self, image: Float[Tensor, "batch 3 _h _w"]) -> Float[Tensor, "batch out_channels height width"]:
        """Return features of images in [-1, 1], of the first convolution's resolution."""
        h = F.relu(self.norm(self.conv(image)))
        levels = [h]
        h = self.pool(h)
        for stage in self.stages:
            h = stage(h)
            levels.append(h)
        return side_by_side(levels, levels[0].shape[-2:])


def residual_stage(channels: int, out: int, blocks: int, stride: int, groups: int) -> nn.Sequential:
    """Build `blocks` residual blocks, of which the first changes channels and resolution."""

    def norm(width: int) -> nn.GroupNorm:
        return nn.GroupNorm(groups, width)

    shortcut = None
    if stride != 1 or channels != out:
        shortcut = nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), norm(out))
    first = BasicBlock(channels, out, stride, shortcut, norm_layer=norm)
    return nn.Sequential(first, *(BasicBlock(out, out, norm_layer=norm) for _ in range(blocks - 1)))


def side_by_side(levels: Sequence[Tensor], size: Sequence[int]) -> Float[Tensor, "batch channels height width"]:
    """Resize feature maps to one size, edges aligned, and concatenate them."""
    resized = [F.interpolate(level, size=tuple(size), mode="bilinear", align_corners=False) for level in levels]
    return torch.cat(resized, 1)


def he_convolutions(module: nn.Module) -> None:
    """Set torchvision's initial weights of a ResNet's convolutions."""
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_out", nonlinearity="relu")


def check_groups(groups: int, channels: Sequence[int]) -> None:
    """Raise ConfigError unless GroupNorm can split all of `channels`."""
    if groups < 1 or any(width % groups for width in channels):
        raise ConfigError(f"model.field.encoder.groups={groups} must divide {', '.join(map(str, channels))} channels")
