"""Camera-aligned triplanes: ξ_W(x) of the paper (eq. in "Single-image NeRF with Local Triplanes")."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.field.frustum import frustum_coordinates
from nerfdiff.utils.precision import at_least_single, full_precision

# Which of (x̃, ỹ, z̃) runs along the (width, height) of each plane: W_xy, W_xz, W_yz.
# W_yz keeps y along its height, as W_xy does.
_AXES = ((0, 1), (0, 2), (2, 1))


@dataclass(frozen=True)
class Triplane:
    """Three feature planes in the frustum of the input camera; there is no world frame.

    Args:
        planes: W_xy, W_xz, W_yz. xy is aligned with the input image, whatever its resolution; z runs along the
            height of xz and along the width of yz.
        cameras: the input cameras, in whose space points are given (their `c2w` plays no part).
        near, far: t_n and t_f, depths of the frustum's ends.
    """

    planes: Float[Tensor, "batch 3 channels height width"]
    cameras: Cameras
    near: Float[Tensor, "batch"]
    far: Float[Tensor, "batch"]

    @staticmethod
    def join(triplanes: Sequence["Triplane"]) -> "Triplane":
        """Join triplanes of one size into one batch."""
        planes, near, far = (torch.cat([getattr(t, name) for t in triplanes]) for name in ("planes", "near", "far"))
        return Triplane(planes, Cameras.join([t.cameras for t in triplanes]), near, far)

    def frustum_coordinates(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n 3"], Bool[Tensor, "batch n"]]:
        """See `nerfdiff.field.frustum`."""
        return frustum_coordinates(points, self.cameras, self.near, self.far)

    def sample(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n channels"], Bool[Tensor, "batch n"]]:
        """Return ξ_W at points of the input camera's space, and where it is defined.

        Outside the frustum's sides and back the border features continue. Coordinates and interpolation weights
        stay fp32: in bf16 they are off by up to an eighth of a texel on a plane of 128.
        """
        batch, n, _ = points.shape
        with full_precision(points.device):
            coordinates, valid = self.frustum_coordinates(at_least_single(points))
            axes = coordinates.unbind(-1)
            grid = torch.stack([torch.stack([axes[across], axes[down]], -1) for across, down in _AXES], 1)
            features = F.grid_sample(
                at_least_single(self.planes).flatten(0, 1),
                grid.flatten(0, 1)[:, None],
                padding_mode="border",
                align_corners=False,
            )
        features = features.reshape(batch, 3, -1, n).sum(1).mT
        return features, valid
