"""Camera-aligned triplanes: ξ_W(x) of the paper (eq. in "Single-image NeRF with Local Triplanes")."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras, along_axes
from nerfdiff.precision import at_least_single, full_precision

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
        """Triplanes of one size, one after the other in one batch."""
        planes, near, far = (torch.cat([getattr(t, name) for t in triplanes]) for name in ("planes", "near", "far"))
        return Triplane(planes, Cameras.join([t.cameras for t in triplanes]), near, far)

    def frustum_coordinates(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n 3"], Bool[Tensor, "batch n"]]:
        """x̃ = [P(x), 2 (x_z − t_n) / (t_f − t_n) − 1], and whether the point lies beyond the near plane.

        x̃ is in [-1, 1]³ inside the frustum; -1 and 1 are the outer edges of the border pixels. Points before
        t_n are masked before the division: behind the camera they would project to mirrored features.
        """
        near, far = self.near[:, None], self.far[:, None]
        x, y, z = points.unbind(-1)
        valid = z >= near
        before = torch.where(valid, z, 1.0)
        fx, fy, cx, cy = (self.cameras.K[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        u, v = fx * x / before + cx, fy * y / before + cy
        projected = [2 * u / self.cameras.width - 1, 2 * v / self.cameras.height - 1]
        depth = 2 * (z - near) / (far - near) - 1
        coordinates = [torch.where(valid, coordinate, 0.0) for coordinate in (*projected, depth)]
        return along_axes(coordinates), valid

    def sample(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n channels"], Bool[Tensor, "batch n"]]:
        """ξ_W at points of the input camera's space, and where it is defined.

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
