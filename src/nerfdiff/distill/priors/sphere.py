"""Π for any picture: cameras on a sphere around what the input camera looks at."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import with_source_lens
from nerfdiff.errors import ConfigError
from nerfdiff.orbit import look_at


@dataclass(frozen=True)
class Sphere:
    """Cameras spread evenly (a Fibonacci lattice) over a band of the sphere around the middle of the scene.

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
        (low, high), (start, end) = self.elevation, self.azimuth
        if not -90 < low <= high < 90 or not start < end <= start + 360 or not -90 < self.source_elevation < 90:
            raise ConfigError(
                f"prior: elevation={[low, high]} must ascend within (-90, 90), "
                f"azimuth={[start, end]} span at most 360, "
                f"source_elevation={self.source_elevation} be within (-90, 90)"
            )

    def __call__(self, scene: ViewBatch) -> Cameras:
        radius = float(scene.near[0] + scene.far[0]) / 2
        tilt = math.radians(self.source_elevation)
        # the input camera stands at the origin and looks along z, its y pointing down
        up = torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)], dtype=torch.float64)
        front = torch.tensor([0.0, math.sin(tilt), -math.cos(tilt)], dtype=torch.float64)
        middle = torch.tensor([0.0, 0.0, radius], dtype=torch.float64)
        index = torch.arange(self.views, dtype=torch.float64) + 0.5
        low, high = (math.sin(math.radians(e)) for e in self.elevation)
        height = low + (high - low) * index / self.views  # on a sphere the height is uniform
        start, end = (math.radians(a) for a in self.azimuth)
        turn = start + (end - start) * (index * (5**0.5 - 1) / 2 % 1)
        across = turn.cos()[:, None] * front + turn.sin()[:, None] * torch.linalg.cross(up, front)
        arms = height[:, None] * up + (1 - height**2).sqrt()[:, None] * across
        return with_source_lens(look_at(middle + radius * arms, middle, up), scene)
