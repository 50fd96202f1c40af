"""Checks of cameras by themselves: intrinsics, rigid poses, and whether they look at something."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Finding
from nerfdiff.trajectories import look_at_point


@dataclass(frozen=True)
class Intrinsics:
    """K has no skew, its principal point is near the image's middle, and its field of view is that of a camera.

    Args:
        max_offset: of the principal point from the middle of the image, as a share of the image's side. K of another
            resolution puts it at an image corner or outside.
        min_fov, max_fov: degrees across the larger side.
    """

    max_offset: float
    min_fov: float
    max_fov: float
    tolerated: float

    measures: ClassVar[str] = "principal point off the middle, share of the image"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        K = scene.cameras.K.double()
        height, width = scene.cameras.height, scene.cameras.width
        if not K.isfinite().all() or (K[:, 0, 0] <= 0).any() or (K[:, 1, 1] <= 0).any():
            return Finding.judged(math.inf, "focal lengths must be positive and finite")
        size = K.new_tensor([width, height])
        offset = ((K[:, :2, 2] - size / 2) / size).abs().max().item()
        expected = K.new_zeros(3, 3)
        expected[2, 2] = 1
        rest = K * K.new_tensor([[0, 1, 0], [1, 0, 0], [1, 1, 1]]) - expected
        if rest.abs().max() > 1e-4:
            return Finding.judged(offset, "K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        fov = field_of_view(scene.cameras)
        reason = None
        if offset > self.max_offset:
            worst = ((K[:, :2, 2] - size / 2) / size).abs().amax(1).argmax()
            cx, cy = K[worst, :2, 2].tolist()
            reason = (
                f"principal point ({cx:.4g}, {cy:.4g}) of view {scene.views[worst]} is far from the middle of an image "
                f"of {width}x{height}: are these the intrinsics of another resolution?"
            )
        elif not (self.min_fov <= fov.min() and fov.max() <= self.max_fov):
            reason = (
                f"field of view of {fov.min():.3g} to {fov.max():.3g} degrees, expected {self.min_fov} to "
                f"{self.max_fov}: is the focal length in pixels of this resolution?"
            )
        return Finding.judged(offset, reason)


@dataclass(frozen=True)
class Poses:
    """Poses are finite rotations and translations that do not mirror space.

    Args:
        max_deviation: of R·Rᵀ from the identity, which rounding explains.
    """

    max_deviation: float
    tolerated: float

    measures: ClassVar[str] = "R·Rᵀ off the identity"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        c2w = scene.cameras.c2w.double()
        if not c2w.isfinite().all():
            return Finding.judged(math.inf, "a pose holds NaN or infinity")
        R = c2w[:, :3, :3]
        off = (R @ R.mT - torch.eye(3).to(R)).abs().amax((1, 2))
        last = (c2w[:, 3] - c2w.new_tensor([0, 0, 0, 1])).abs().max()
        value, worst = off.max().item(), scene.views[int(off.argmax())]
        reason = None
        if max(value, last) > self.max_deviation:
            reason = f"the pose of view {worst} is not a rotation and a translation"
        elif (mirrored := (torch.linalg.det(R) < 0).sum().item()) > 0:
            reason = f"{mirrored} of {len(R)} poses mirror space (det R < 0): one axis too many or too few is flipped"
        return Finding.judged(value, reason)


@dataclass(frozen=True)
class OpticalAxes:
    """The optical axes meet at one place, and it lies in front of the cameras.

    Args:
        max_residual: median distance of that place from an axis over its distance from the camera: how far off
            the middle of its images a photographed object may be (0.25 is 14 degrees).
        min_in_front: share of the cameras that must have it in front of them.
        min_turn: largest angle between two axes, in degrees; cameras that turn less are near-parallel, and
            where they look cannot be told.
        min_spread: of the camera centres around their mean, over `far`: cameras that stand in one place.
    """

    max_residual: float
    min_in_front: float
    min_turn: float
    min_spread: float
    tolerated: float

    measures: ClassVar[str] = "distance of the axes' intersection from an axis, over that from the camera"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        cameras = scene.cameras.to(torch.float64)
        if len(cameras) < 2 or turn(cameras) < self.min_turn:
            return Finding.unchecked(f"the optical axes are within {self.min_turn} degrees of each other")
        spread = (cameras.centres - cameras.centres.mean(0)).norm(dim=1).square().mean().sqrt().item()
        if spread < self.min_spread * scene.far:
            return Finding.judged(math.inf, "all cameras stand in one place: are the poses world-to-camera?")
        point = look_at_point(cameras)
        offset = point - cameras.centres
        ahead = (offset * cameras.c2w[:, :3, 2]).sum(-1)
        distance = offset.norm(dim=1)
        across = (distance.square() - ahead.square()).clamp_min(0).sqrt()
        residual = (across / distance.clamp_min(1e-9)).median().item()
        in_front = (ahead > 0).double().mean().item()
        reason = None
        if in_front < self.min_in_front:
            reason = (
                f"what the cameras look at lies behind {1 - in_front:.0%} of them: are the axes OpenGL's "
                "(y up, z backward), or the poses world-to-camera?"
            )
        elif residual > self.max_residual:
            reason = (
                f"the optical axes do not meet: they miss the closest point by {residual:.2g} of its distance; do the "
                "cameras look at one object, and are the poses camera-to-world with OpenCV axes?"
            )
        return Finding.judged(residual, reason)


def turn(cameras: Cameras) -> float:
    """Largest angle between two optical axes, in degrees."""
    forward = cameras.c2w[:, :3, 2].double()
    return math.degrees(math.acos((forward @ forward.mT).min().clamp(-1, 1).item()))


def field_of_view(cameras: Cameras) -> Float[Tensor, " views"]:
    """Degrees across the larger side of the image."""
    axis, side = (0, cameras.width) if cameras.width >= cameras.height else (1, cameras.height)
    return torch.rad2deg(2 * torch.atan(side / (2 * cameras.K[..., axis, axis].double())))
