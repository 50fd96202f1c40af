"""Another view of the scene as the input."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.trajectories import look_at_point, up_direction


def _directions(cameras: Cameras) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "3"]]:
    """Return unit vectors from what the cameras look at to each of them, and up."""
    arms = cameras.centres - look_at_point(cameras)
    return torch.nn.functional.normalize(arms, dim=-1), up_direction(cameras)


def elevation(cameras: Cameras, own: int, severity: float, tolerance: float) -> int | None:
    """Return the view whose elevation is nearest to so many degrees, of several the one turned least from view `own`.

    Args:
        cameras: [n], of all views.
        tolerance: degrees by which it may miss; None is returned where no view is as near.
    """
    directions, up = _directions(cameras)
    degrees = torch.rad2deg(torch.asin((directions @ up).clamp(-1, 1)))
    off = (degrees - severity).abs()
    level = torch.nn.functional.normalize(directions - (directions @ up)[:, None] * up, dim=-1)
    turned = 1 - level @ level[own]
    fits = off <= tolerance
    return int(torch.where(fits, turned, torch.inf).argmin()) if bool(fits.any()) else None


def direction(
    cameras: Cameras, own: int, severity: float, tolerance: float, towards: Sequence[Sequence[float]]
) -> int | None:
    """Return the view that looks from the direction number `severity`, counted from 1.

    Args:
        cameras: [n], of all views, in the dataset's world.
        tolerance: degrees between the two directions; None is returned where no view is as near.
        towards: vectors in the dataset's world, from the object to the camera.
    """
    directions, _ = _directions(cameras)
    wanted = torch.nn.functional.normalize(torch.tensor(towards[int(severity) - 1], dtype=torch.float32), dim=0)
    cosines = directions @ wanted.to(directions)
    best = int(cosines.argmax())
    return best if float(cosines[best]) >= math.cos(math.radians(tolerance)) else None
