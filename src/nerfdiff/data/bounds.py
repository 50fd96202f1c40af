"""What a scene's cameras look at, and bounds of the scene from it, where nobody states them."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nerfdiff.data.optical_axes import closest_point
from nerfdiff.errors import DataError

MIN_SPREAD = 0.005
"""Mean squared sine between the optical axes and their main direction (4° root mean square) below which where they
meet is left to chance."""
MIN_NEAR = 0.05
"""Least near, relative to the distance of the closest camera: a sample at the camera itself is of no use."""


@dataclass(frozen=True)
class Gaze:
    """Where optical axes meet.

    Args:
        point: closest to all axes in the least-squares sense; of no meaning where the axes are near parallel.
        distances: from each camera to it.
        ahead: which cameras have it before them.
        parallel: whether the axes are near parallel, as those of one view or of a forward-facing capture.
    """

    point: Float[np.ndarray, "3"]
    distances: Float[np.ndarray, " views"]
    ahead: Bool[np.ndarray, " views"]
    parallel: bool

    @staticmethod
    def of(c2w: Float[np.ndarray, "views 4 4"]) -> "Gaze":
        """From camera-to-world matrices with OpenCV axes."""
        axes, centres = c2w[:, :3, 2], c2w[:, :3, 3]
        point, across = closest_point(c2w)
        spread = np.linalg.eigvalsh(across.mean(0))[0]
        offsets = point - centres
        return Gaze(
            point,
            np.linalg.norm(offsets, axis=1),
            np.einsum("vi,vi->v", offsets, axes) > 0,
            bool(spread < MIN_SPREAD),
        )

    def refuse_outward(self, where: str | Path, convention: str) -> None:
        """Refuse cameras most of which look away from where their axes meet; near-parallel axes tell nothing.

        Raises:
            DataError: they do; that is what poses of another convention look like.
        """
        if self.parallel or self.ahead.mean() >= 0.5:
            return
        other = {"opengl": "opencv", "opencv": "opengl"}[convention]
        raise DataError(
            f"{where}: {(~self.ahead).sum()} of {len(self.ahead)} cameras look away from where their optical axes "
            f"meet; expected {convention} camera-to-world poses. If they are {other} ones set "
            f"data.reader.convention={other}, if they truly look outward data.reader.inward=false"
        )

    def bounds(self, half_angle: float, where: str | Path) -> tuple[float, float]:
        """Near and far that enclose, for every camera, a ball around `point`.

        Its radius is that of the ball that fills the wider side of the image in the middle one of the cameras, which
        for images framed around an object is what they were framed by.

        Args:
            half_angle: half the field of view along the wider side, in radians, of the widest image as it was framed:
                what is cropped later shows less of an object, but no less of its depth.

        Raises:
            DataError: the axes are near parallel, or no camera looks at where they meet.
        """
        if self.parallel or not self.ahead.any():
            raise DataError(
                f"{where}: near and far cannot be estimated from {len(self.ahead)} cameras whose optical axes do not "
                "meet before them; set data.reader.near and data.reader.far, in units of the poses"
            )
        distances = self.distances[self.ahead]
        radius = float(np.median(distances)) * math.sin(half_angle)
        nearest = float(distances.min())
        return max(nearest - radius, MIN_NEAR * nearest), float(distances.max()) + radius
