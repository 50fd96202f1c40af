"""Radiance fields: colour and density of points."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.field.decoder import Decoder
from nerfdiff.field.pixel_features import PixelFeatures
from nerfdiff.field.residual_mlp import ResidualMLP
from nerfdiff.field.triplane import Triplane


@runtime_checkable
class Field(Protocol):
    """A radiance field, as the renderer asks for it."""

    def __call__(
        self, points: Float[Tensor, "batch n 3"], directions: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"]]:
        """Return colours in [0, 1] and densities per scene unit.

        Args:
            points: in the input camera's space, in scene units.
            directions: unit direction of each point's ray, in the same space; a field may ignore them.
        """


@dataclass(frozen=True)
class TriplaneField:
    """f_θ(ξ_W(x)): colour and density of points in the input camera's space."""

    triplane: Triplane
    decoder: Decoder

    def __call__(
        self, points: Float[Tensor, "batch n 3"], directions: Float[Tensor, "batch n 3"] | None = None
    ) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"]]:
        """See `Field`; the colour is the same from all directions."""
        features, valid = self.triplane.sample(points)
        rgb, density = self.decoder(features)
        return rgb, self.per_scene_unit(density, valid)

    def per_scene_unit(
        self, density: Float[Tensor, "batch n"], valid: Bool[Tensor, "batch n"]
    ) -> Float[Tensor, "batch n"]:
        """Convert the decoder's density per unit of the frustum's depth; 0 where the features are not valid."""
        return _per_scene_unit(density, valid, self.triplane)


@dataclass(frozen=True)
class PixelField:
    """f_θ(x, d, W(P(x))) of a pixel-aligned NeRF, whose colour and density also depend on the viewing direction.

    Args:
        features: W, or the outputs of the MLP's layers that take W alone.
        decoder: f_θ.
        weights: of these layers, for each map that they are still to be applied to; None where they have been.
    """

    features: PixelFeatures
    decoder: ResidualMLP
    weights: tuple[Tensor | None, ...]

    @staticmethod
    def of(features: PixelFeatures, decoder: ResidualMLP) -> "PixelField":
        """Make a field that renders fast.

        Interpolation is linear, as those layers are, so they may come first. They do where that leaves no more channels
        to gather at a point; then they are applied to pixels, not to points.
        """
        weight, _ = decoder.injection()
        maps, weights = [], []
        for one, share in zip(features.maps, weight.split([one.shape[1] for one in features.maps], 1), strict=True):
            first = len(share) <= one.shape[1]
            maps.append(F.conv2d(one, share[..., None, None]) if first else one)
            weights.append(None if first else share)
        return PixelField(replace(features, maps=maps), decoder, tuple(weights))

    def __call__(
        self, points: Float[Tensor, "batch n 3"], directions: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"]]:
        """See `Field`."""
        sampled, valid = self.features.sample(points)
        _, injected = self.decoder.injection()
        parts = sampled.split([one.shape[1] for one in self.features.maps], -1)
        for part, weight in zip(parts, self.weights, strict=True):
            injected = injected + (part if weight is None else F.linear(part, weight))
        rgb, density = self.decoder.from_injected(self.features.centred(points), directions, injected)
        return rgb, _per_scene_unit(density, valid, self.features)


def _per_scene_unit(
    density: Float[Tensor, "batch n"], valid: Bool[Tensor, "batch n"], frustum: Triplane | PixelFeatures
) -> Float[Tensor, "batch n"]:
    depth = (frustum.far - frustum.near)[:, None]
    return torch.where(valid, density / depth, 0.0)
