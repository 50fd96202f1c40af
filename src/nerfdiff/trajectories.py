"""A circle of cameras around what a set of cameras looks at, estimated from the cameras alone."""

import math
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Upright:
    """How a scene stands in the space of its input camera.

    Args:
        point: what cameras look at.
        up: a unit vector.
    """

    point: Float[Tensor, "3"]
    up: Float[Tensor, "3"]

    @staticmethod
    def seen_by(cameras: Cameras) -> "Upright":
        """Estimate it from level cameras [n] that look at one point from at least two sides."""
        return Upright(look_at_point(cameras), up_direction(cameras))

    @staticmethod
    def assumed(distance: float, elevation: float) -> "Upright":
        """Take the input camera to look at what is `distance` before it, down from `elevation` degrees."""
        tilt = math.radians(elevation)  # the input camera stands at the origin and looks along z, its y pointing down
        return Upright(torch.tensor([0.0, 0.0, distance]), torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)]))

    def to(self, *args, **kwargs) -> "Upright":
        """Move or cast as `Tensor.to`."""
        return Upright(self.point.to(*args, **kwargs), self.up.to(*args, **kwargs))

    def axes(self, source: Cameras) -> Float[Tensor, "3 3"]:
        """Unit vectors to the right, up, and to the front, which is the side of the camera `source` [1]."""
        front = self.around(source, torch.zeros(1).to(self.up), torch.zeros(1).to(self.up)).c2w[0, :3, 2].neg()
        return torch.stack([torch.linalg.cross(self.up, front), self.up, front])

    def elevation(self, cameras: Cameras) -> Float[Tensor, "n"]:
        """Degrees above the horizon from which cameras [n] look at the point."""
        arms = cameras.centres - self.point
        return torch.rad2deg(torch.asin((arms @ self.up / arms.norm(dim=-1)).clamp(-1, 1)))

    def around(self, source: Cameras, azimuth: Float[Tensor, "n"], elevation: Float[Tensor, "n"] | None) -> Cameras:
        """Cameras [n] that look at the point from the distance of the camera `source` [1], with its lens.

        Args:
            azimuth: degrees, anticlockwise seen from above; 0 is the source's.
            elevation: degrees above the horizon; None: the source's.
        """
        arm = source.centres[0] - self.point
        height = arm @ self.up
        across = arm - height * self.up
        if across.norm() < 1e-6 * arm.norm():  # straight above: the image's lower edge is the front
            below = source.c2w[0, :3, 1]
            across = below - (below @ self.up) * self.up
        front = across / across.norm()
        angle = torch.deg2rad(azimuth)[:, None]
        direction = angle.cos() * front + angle.sin() * torch.linalg.cross(self.up, front)
        if elevation is None:
            centres = self.point + height * self.up + (arm - height * self.up).norm() * direction
        else:
            angle = torch.deg2rad(elevation)[:, None]
            centres = self.point + arm.norm() * (angle.cos() * direction + angle.sin() * self.up)
        n = len(azimuth)
        return Cameras(look_at(centres, self.point, self.up), source.K.expand(n, 3, 3), source.height, source.width)


def orbit(source: Cameras, others: Cameras, frames: int) -> Cameras:
    """A full turn from the source camera around what all cameras look at, at the source's height and distance.

    Args:
        source: [1]; others: [n], in the same space.
    """
    azimuth = torch.arange(frames, device=source.K.device) / frames * 360
    return Upright.seen_by(Cameras.join([source, others])).around(source, azimuth, None)
