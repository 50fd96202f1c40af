"""A circle of cameras around what a set of cameras looks at, estimated from the cameras alone."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras


def look_at_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point closest to all optical axes in the least-squares sense.

    Args:
        cameras: [n], n >= 2, not all parallel.
    """
    forward = cameras.c2w[:, :3, 2].double()
    # Each axis constrains the point across its direction: Σ (I − d dᵀ)(p − C) = 0.
    across = torch.eye(3, dtype=torch.float64, device=forward.device) - forward[:, :, None] * forward[:, None]
    rhs = (across @ cameras.centres.double()[..., None]).sum(0)
    return torch.linalg.lstsq(across.sum(0), rhs).solution[:, 0].to(cameras.c2w)


def up_direction(cameras: Cameras) -> Float[Tensor, "3"]:
    """The unit up vector of cameras held level (no roll): it is at right angles to every camera's x axis.

    Args:
        cameras: [n], n >= 2, looking in at least two directions.
    """
    x_axes = cameras.c2w[:, :3, 0].double()
    up = torch.linalg.svd(x_axes, full_matrices=True).Vh[-1]
    mean_up = -cameras.c2w[:, :3, 1].double().mean(0)
    return (torch.where(up @ mean_up < 0, -up, up)).to(cameras.c2w)


def look_at(centres: Float[Tensor, "n 3"], point: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "n 4 4"]:
    """Level camera-to-world matrices at `centres` that look at `point` (OpenCV axes)."""
    z = torch.nn.functional.normalize(point - centres, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, up.expand_as(z)), dim=-1)
    c2w = torch.eye(4).to(centres).repeat(len(centres), 1, 1)
    c2w[:, :3] = torch.stack([x, torch.linalg.cross(z, x), z, centres], -1)
    return c2w


def orbit(source: Cameras, others: Cameras, frames: int) -> Cameras:
    """A full turn from the source camera around what all cameras look at, at the source's height and distance.

    Args:
        source: [1]; others: [n], in the same space.
    """
    everyone = Cameras.join([source, others])
    point, up = look_at_point(everyone), up_direction(everyone)
    arm = source.centres[0] - point
    height = (arm @ up) * up
    across = arm - height
    angles = torch.arange(frames, device=arm.device) / frames * 2 * math.pi
    turned = angles.cos()[:, None] * across + angles.sin()[:, None] * torch.linalg.cross(up, across)
    c2w = look_at(point + height + turned, point, up)
    return Cameras(c2w, source.K.expand(frames, 3, 3), source.height, source.width)
