"""Π: the virtual views' cameras, relative to the input camera (paper, appendix, "Prior")."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.poses import SPIRAL_VIEWS, srn_spiral
from nerfdiff.trajectories import Upright, look_at, look_at_point
from nerfdiff.utils.errors import ConfigError, DataError

log = logging.getLogger(__name__)


@runtime_checkable
class Prior(Protocol):
    """Place the virtual cameras of a scene.

    The call is all that is asked of a prior: rows of results record its class's name, and as K the number of cameras.
    """

    def __call__(self, scene: ViewBatch) -> Cameras:
        """Return cameras [1, K] in the input camera's space, with the input's intrinsics, for a batch of one scene."""


def with_source_lens(c2w: Float[Tensor, "views 4 4"], scene: ViewBatch) -> Cameras:
    """Return cameras [1, views] with the input's intrinsics and image size."""
    own = scene.source_cameras
    return Cameras(c2w[None].to(own.K), own.K[:1, None].expand(1, len(c2w), 3, 3), own.height, own.width)


def all_cameras(scene: ViewBatch) -> Cameras:
    """Return the cameras [views] of a scene: the input camera (the identity), then the target cameras."""
    return Cameras.join([scene.source_cameras, scene.target_cameras[0]])


@dataclass(frozen=True)
class Circle:
    """Place cameras on the circle through the scene's, with the same look-at point (paper, appendix, "Clevr3D").

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
    """Return the unit normal of the plane through the cameras' centres, on the side from which they look down.

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


@dataclass(frozen=True)
class SceneCameras:
    """Take the input camera and those of the views to predict, spread evenly if there are more than K.

    Of these views nothing but the poses is used, which ABO's renders share among all objects. Where there are fewer
    than K, as with `data.eval_stride` above 1, a log line says so once.

    Args:
        views: K at most; ABO has 30 (paper).
    """

    views: int

    def __call__(self, scene: ViewBatch) -> Cameras:
        c2w = all_cameras(scene).c2w
        if len(c2w) < self.views:
            _warn_of_fewer(len(c2w), self.views)
        count = min(self.views, len(c2w))
        return with_source_lens(c2w[[i * len(c2w) // count for i in range(count)]], scene)


@cache
def _warn_of_fewer(there: int, asked: int) -> None:
    log.warning(
        "prior=abo_views: %d virtual views instead of the %d of budget.views: a scene has no more cameras "
        "(data.eval_stride above 1 leaves some out)",
        there,
        asked,
    )


@dataclass(frozen=True)
class Sphere:
    """Spread cameras evenly (a Fibonacci lattice) over a band of the sphere around the middle of the scene.

    The middle is on the input camera's axis, half way between near and far; up is the input camera's, tilted by the
    elevation from which it is assumed to look.

    Args:
        views: K.
        elevation: lowest and highest, in degrees.
        azimuth: from and to, in degrees; 0 is the input camera's.
        source_elevation: of the input camera, in degrees.

    Raises:
        ConfigError: no views, or ranges that are none.
    """

    views: int
    elevation: Sequence[float]
    azimuth: Sequence[float]
    source_elevation: float

    def __post_init__(self):
        if self.views < 1:
            raise ConfigError(f"prior.views={self.views} must be at least 1 (budget.views)")
        if isinstance(self.source_elevation, str):
            raise ConfigError(
                f"prior.source_elevation={self.source_elevation}: expected degrees; auto is for pictures alone"
            )
        (low, high), (start, end) = self.elevation, self.azimuth
        if not -90 < low <= high < 90 or not start < end <= start + 360 or not -90 < self.source_elevation < 90:
            raise ConfigError(
                f"prior: elevation={[low, high]} must ascend within (-90, 90), "
                f"azimuth={[start, end]} span at most 360, "
                f"source_elevation={self.source_elevation} be within (-90, 90)"
            )

    def __call__(self, scene: ViewBatch) -> Cameras:
        radius = float(scene.near[0] + scene.far[0]) / 2
        stands = Upright.assumed(radius, self.source_elevation).to(torch.float64)
        middle, up = stands.point, stands.up
        front = torch.stack([torch.zeros_like(up[2]), -up[2], up[1]])
        index = torch.arange(self.views, dtype=torch.float64) + 0.5
        low, high = (math.sin(math.radians(e)) for e in self.elevation)
        height = low + (high - low) * index / self.views  # on a sphere the height is uniform
        start, end = (math.radians(a) for a in self.azimuth)
        turn = start + (end - start) * (index * (5**0.5 - 1) / 2 % 1)
        across = turn.cos()[:, None] * front + turn.sin()[:, None] * torch.linalg.cross(up, front)
        arms = height[:, None] * up + (1 - height**2).sqrt()[:, None] * across
        return with_source_lens(look_at(middle + radius * arms, middle, up), scene)


@dataclass(frozen=True)
class SRNSpiral:
    """Choose cameras of SRN's test spiral evenly, relative to its view `source_view`, without a pose file.

    Args:
        views: K; 50 takes every fifth of the 251 views (paper).
        source_view: the view that the input image is.
        radius: of the spiral; None: the input camera's distance from what the scene's cameras look at, which is 1.3
            for SRN's cars and 2 for its chairs.
        min_cosine: between the input camera's axis and the direction of that point, for a radius to be found.

    Raises:
        ConfigError: more views than the spiral has, none, or a source view, radius or cosine that it cannot have.
        DataError: there is no radius, and the scene has no second camera to find it by.
    """

    views: int
    source_view: int
    radius: float | None
    min_cosine: float

    def __post_init__(self):
        for key, possible, expected in (
            ("views", 1 <= self.views <= SPIRAL_VIEWS, f"1 to {SPIRAL_VIEWS}, the spiral's views"),
            ("source_view", 0 <= self.source_view < SPIRAL_VIEWS, f"one of the spiral's, 0 to {SPIRAL_VIEWS - 1}"),
            ("radius", self.radius is None or self.radius > 0, "a positive distance in scene units, or null"),
            ("min_cosine", 0 <= self.min_cosine < 1, "from 0 to less than 1"),
        ):
            if not possible:
                raise ConfigError(f"prior.{key}={getattr(self, key)}: expected {expected}")

    def __call__(self, scene: ViewBatch) -> Cameras:
        spiral = torch.from_numpy(srn_spiral(self._radius(scene) if self.radius is None else self.radius))
        every = [k * SPIRAL_VIEWS // self.views for k in range(self.views)]
        source = with_source_lens(spiral[[self.source_view]], scene)
        return with_source_lens(spiral[every], scene).relative_to(source)

    def _radius(self, scene: ViewBatch) -> float:
        point = look_at_point(all_cameras(scene))
        radius = float(point.norm())  # the input camera stands at the origin, and looks along z
        if not float(point[2]) > self.min_cosine * radius:
            raise DataError(
                "prior=srn_spiral takes its radius from what the scene's cameras look at, but scene "
                f"{scene.scene_ids[0]} has no second camera that looks at the same point as its input camera; set "
                "prior.radius, or use prior=sphere"
            )
        return radius
