"""Π for SRN-ShapeNet: its test trajectory."""

from dataclasses import dataclass

import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import all_cameras, with_source_lens
from nerfdiff.errors import ConfigError, DataError
from nerfdiff.orbit import look_at_point
from nerfdiff.scenes.poses import SPIRAL_VIEWS, srn_spiral

IN_SIGHT = 0.9
"""Least cosine between the input camera's axis and the direction of what all look at."""


@dataclass(frozen=True)
class SRNSpiral:
    """Evenly chosen cameras of SRN's test spiral, relative to its view `source_view`: no pose file is needed.

    Args:
        views: K; 50 takes every fifth of the 251 views (paper).
        source_view: the view that the input image is.
        radius: of the spiral; None: the input camera's distance from what the scene's cameras look at, which is 1.3
            for SRN's cars and 2 for its chairs.

    Raises:
        ConfigError: more views than the spiral has, none, or a source view or radius that it cannot have.
        DataError: there is no radius, and the scene has no second camera to find it by.
    """

    views: int
    source_view: int
    radius: float | None

    def __post_init__(self):
        for key, possible, expected in (
            ("views", 1 <= self.views <= SPIRAL_VIEWS, f"1 to {SPIRAL_VIEWS}, the spiral's views"),
            ("source_view", 0 <= self.source_view < SPIRAL_VIEWS, f"one of the spiral's, 0 to {SPIRAL_VIEWS - 1}"),
            ("radius", self.radius is None or self.radius > 0, "a positive distance in scene units, or null"),
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
        if not float(point[2]) > IN_SIGHT * radius > 0:
            raise DataError(
                "prior=srn_spiral takes its radius from what the scene's cameras look at, but scene "
                f"{scene.scene_ids[0]} has no second camera that looks at the same point as its input camera; set "
                "prior.radius, or use prior=sphere"
            )
        return radius
