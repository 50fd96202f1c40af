"""A radiance field: what the renderer calls at points."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.field.decoder import Decoder
from nerfdiff.field.triplane import Triplane

# points [batch, n, 3] -> (colour [batch, n, 3] in [0, 1], density [batch, n] per scene unit)
FieldFn = Callable[[Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class TriplaneField:
    """f_θ(ξ_W(x)): colour and density of points in the input camera's space."""

    triplane: Triplane
    decoder: Decoder

    def __call__(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"]]:
        features, valid = self.triplane.sample(points)
        rgb, density = self.decoder(features)
        return rgb, self.per_scene_unit(density, valid)

    def per_scene_unit(
        self, density: Float[Tensor, "batch n"], valid: Bool[Tensor, "batch n"]
    ) -> Float[Tensor, "batch n"]:
        """The decoder's density, which is per unit of the frustum's depth; 0 where the features are not valid."""
        depth = (self.triplane.far - self.triplane.near)[:, None]
        return torch.where(valid, density / depth, 0.0)
