"""Π for Clevr3D: the circle on which its cameras stand, found from their relative poses."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import all_cameras, with_source_lens
from nerfdiff.errors import DataError
from nerfdiff.orbit import look_at, look_at_point


@dataclass(frozen=True)
class Circle:
    """Cameras on the circle through the scene's, looking at what they look at (paper, appendix, "Clevr3D").

    All in the input camera's space: the look-at point is the intersection of the optical axes; up is the normal of
    the plane that holds the cameras, on the side from which they look down; the circle lies in that plane around the
    axis through the look-at point, at the cameras' mean distance from it.

    Args:
        views: K (paper: 50).
    """

    views: int

    def __call__(self, scene: ViewBatch) -> Cameras:
        cameras = all_cameras(scene)
        point, up = look_at_point(cameras), plane_normal(cameras)
        arms = cameras.centres - point
        heights = arms @ up
        across = arms - heights[:, None] * up
        first = across[0] / across[0].norm()
        angles = torch.arange(self.views, device=point.device) / self.views * 2 * math.pi
        turned = angles.cos()[:, None] * first + angles.sin()[:, None] * torch.linalg.cross(up, first)
        centres = point + heights.mean() * up + across.norm(dim=-1).mean() * turned
        return with_source_lens(look_at(centres, point, up), scene)


def plane_normal(cameras: Cameras) -> Float[Tensor, "3"]:
    """The unit normal of the plane through the cameras' centres, on the side from which they look down.

    Raises:
        DataError: fewer than three cameras, or all in one line.
    """
    centred = cameras.centres.double() - cameras.centres.double().mean(0)
    _, spread, axes = torch.linalg.svd(centred, full_matrices=True)
    if len(cameras) < 3 or spread[1] < 1e-6 * spread[0]:
        raise DataError(
            "prior=clevr_circle needs at least three cameras that are not in one line (data.eval_stride above 1 leaves "
            "some out); use prior=sphere"
        )
    normal = axes[-1].to(cameras.c2w)
    # in the upper half-space cameras look down: their directions are against up
    return torch.where((cameras.c2w[:, :3, 2] @ normal).mean() > 0, -normal, normal)
