"""Image features of a transformer and of convolutions beside it: VisionNeRF's encoder (arXiv 2207.05736)."""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.field.resnet import check_groups, he_convolutions, residual_stage, side_by_side
from nerfdiff.field.vision_transformer import VisionTransformer
from nerfdiff.utils.errors import ConfigError


class Reassembled(nn.Module):
    """Tokens of one depth as a feature map (DPT, arXiv 2103.13413): the class token read out into all, then resized.

    Args:
        width: of the tokens.
        channels: of the map before it is made `out` channels wide.
        scale: 4 or 2 enlarge the map, 1 leaves it, -2 halves it.
    """

    def __init__(self, width: int, channels: int, scale: int, out: int):
        super().__init__()
        self.readout = nn.Linear(2 * width, width)
        self.project = nn.Conv2d(width, channels, 1)
        if scale == 1:
            self.resize = nn.Identity()
        elif scale > 1:
            self.resize = nn.ConvTranspose2d(channels, channels, scale, stride=scale)
        else:
            self.resize = nn.Conv2d(channels, channels, 3, stride=-scale, padding=1)
        self.out = nn.Conv2d(channels, out, 3, padding=1, bias=False)

    def forward(
        self, tokens: Float[Tensor, "batch width rows columns"], readout: Float[Tensor, "batch width"]
    ) -> Float[Tensor, "batch out _h _w"]:
        whole = readout[:, None].expand(-1, tokens[0, 0].numel(), -1)
        rows = F.gelu(self.readout(torch.cat([tokens.flatten(2).mT, whole], -1)))
        return self.out(self.resize(self.project(rows.mT.unflatten(2, tokens.shape[-2:]))))


class VisionFeatures(nn.Module):
    """Half of the features from a ViT's tokens of four depths, for what is global, half from convolutions, for detail.

    No weights are downloaded; the convolutions have GroupNorm instead of BatchNorm, so that images of a batch do not
    depend on each other.

    Args:
        transformer: arguments of `VisionTransformer`, with four taps.
        reassembled: channels of the four depths' maps.
        features: in all.
        stem: channels of the first convolution, of stride 2 or `stride`.
        stride: of the first convolution: the features' resolution.
        groups: of GroupNorm.

    Raises:
        ConfigError: see `VisionTransformer`; not four depths; or channels that cannot be split into groups.
    """

    SCALES = (4, 2, 1, -2)

    def __init__(
        self, transformer: Mapping, reassembled: Sequence[int], features: int, stem: int, stride: int, groups: int
    ):
        super().__init__()
        if not len(self.SCALES) == len(reassembled) == len(transformer["taps"]):
            raise ConfigError("model.field.encoder: reassembled and transformer.taps must name four depths each")
        if features % 2:
            raise ConfigError(f"model.field.encoder.features={features} must be even: half are the transformer's")
        half = features // 2
        check_groups(groups, (stem, half))
        self.out_channels = features
        self.transformer = VisionTransformer(**transformer)
        self.depths = nn.ModuleList(
            Reassembled(transformer["width"], channels, scale, features)
            for channels, scale in zip(reassembled, self.SCALES, strict=True)
        )
        self.fuse = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(4 * features, features, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(features, half, 3, padding=1),
        )
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, stem, 7, stride, padding=3, bias=False),
            nn.GroupNorm(groups, stem),
            nn.ReLU(),
            *residual_stage(stem, half, 3, 1, groups),
        )
        he_convolutions(self.convolutions)

    def forward(self, image: Float[Tensor, "batch 3 _h _w"]) -> Float[Tensor, "batch out_channels height width"]:
        """Return features of images in [-1, 1]."""
        local = self.convolutions(image)
        tapped = zip(self.depths, self.transformer(image), strict=True)
        maps = [depth(tokens, readout) for depth, (tokens, readout) in tapped]
        return torch.cat([self.fuse(side_by_side(maps, local.shape[-2:])), local], 1)
