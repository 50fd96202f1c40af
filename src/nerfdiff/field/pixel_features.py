"""Features of the input image at a point's projection: W of pixel-aligned NeRFs.

eq. "pixelnerf" of the paper, after pixelNeRF (arXiv 2012.02190) and VisionNeRF (arXiv 2207.05736).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras, along_axes
from nerfdiff.field.frustum import frustum_coordinates
from nerfdiff.utils.precision import at_least_single, full_precision


@dataclass(frozen=True)
class PixelFeatures:
    """Feature maps aligned with the input images: all points of a ray of the input camera have the same features.

    Args:
        maps: each of its own channels and resolution; their outer edges are the image's.
        cameras: the input cameras, in whose space points are given (their `c2w` plays no part).
        near, far: t_n and t_f, depths of the frustum's ends.
    """

    maps: Sequence[Float[Tensor, "batch _channels _height _width"]]
    cameras: Cameras
    near: Float[Tensor, "batch"]
    far: Float[Tensor, "batch"]

    def sample(
        self, points: Float[Tensor, "batch n 3"]
    ) -> tuple[Float[Tensor, "batch n channels"], Bool[Tensor, "batch n"]]:
        """Return W(P(x)) of all maps, bilinear, at points of the input camera's space, and where it is defined.

        That is beyond the near plane; outside the image the border features continue. Coordinates and interpolation
        weights stay fp32.
        """
        with full_precision(points.device):
            coordinates, valid = frustum_coordinates(at_least_single(points), self.cameras, self.near, self.far)
            grid = coordinates[..., None, :2]
            sampled = [
                F.grid_sample(at_least_single(one), grid, padding_mode="border", align_corners=False)[..., 0]
                for one in self.maps
            ]
        return torch.cat(sampled, 1).mT, valid

    def centred(self, points: Float[Tensor, "batch n 3"]) -> Float[Tensor, "batch n 3"]:
        """Return points along the input camera's axes, from the middle of its frustum, in units of t_f − t_n.

        So they are free of the scene's units and of the camera's distance (pixelNeRF's `normalize_z` does the same by
        taking points from the world's origin, where its objects stand). For SRN's cars t_f − t_n is 1.
        """
        near, far = self.near[:, None], self.far[:, None]
        x, y, z = at_least_single(points).unbind(-1)
        return along_axes([axis / (far - near) for axis in (x, y, z - 0.5 * (near + far))])
