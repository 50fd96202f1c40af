"""Bounds of a scene from the point its cameras look at, where nobody states them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nerfdiff.data.readers.optical_axes import closest_point
from nerfdiff.utils.errors import DataError, some

MIN_SPREAD = 0.005
"""Mean squared sine between the optical axes and their main direction (4° root mean square) below which where they
meet is left to chance."""
MIN_NEAR = 0.05
"""Least near, relative to the distance of the closest camera: a sample at the camera itself is of no use."""
STRAY = 4.0
"""A camera so many times as far from what all look at as the middle one, or as near, is astray."""
MAX_STRAYS = 0.2
"""Largest share of the cameras that may be astray: more of them are a second ring of cameras."""
ROUNDS = 30
"""Rounds of reweighting, for the point with the least sum of distances from the axes."""


@dataclass(frozen=True)
class Gaze:
    """The point where optical axes meet.

    Args:
        point: closest in the least-squares sense to the axes of all cameras but strays; of no meaning where the axes
            are near parallel.
        distances: from each camera to it.
        ahead: which cameras have it before them.
        stray: which few cameras stand at a quite different distance from it than the others, as one does whose pose
            was estimated wrongly.
        parallel: whether the axes are near parallel, as those of one view or of a forward-facing capture.
    """

    point: Float[np.ndarray, "3"]
    distances: Float[np.ndarray, " views"]
    ahead: Bool[np.ndarray, " views"]
    stray: Bool[np.ndarray, " views"]
    parallel: bool

    @staticmethod
    def of(c2w: Float[np.ndarray, "views 4 4"]) -> "Gaze":
        """From camera-to-world matrices with OpenCV axes."""
        axes, centres = c2w[:, :3, 2], c2w[:, :3, 3]
        stray = _astray(c2w)
        point, across = closest_point(c2w[~stray])
        parallel = bool(np.linalg.eigvalsh(across.mean(0))[0] < MIN_SPREAD)
        offsets = point - centres
        return Gaze(
            point,
            np.linalg.norm(offsets, axis=1),
            np.einsum("vi,vi->v", offsets, axes) > 0,
            stray & (not parallel),
            parallel,
        )

    def describe_strays(self, names: Sequence[str]) -> str | None:
        """Say which of these views are astray and how far; None where none is."""
        if not self.stray.any():
            return None
        middle = np.median(self.distances[~self.stray])
        listed = {names[view]: self.distances[view] / middle for view in np.flatnonzero(self.stray)}
        return (
            "stray cameras: "
            + some(
                [f"view {name} is {times:.3g} times as far from what they look at" for name, times in listed.items()]
            )
            + f" as the middle one of {len(self.stray)} cameras"
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
        """Near and far that enclose, for every camera but strays, a ball around `point`.

        Its radius is that of the ball that fills the wider side of the image in the middle one of the cameras, which
        for images framed around an object is what they were framed by.

        Args:
            half_angle: half the field of view along the wider side, in radians, of the widest image as it was framed:
                what is cropped later shows less of an object, but no less of its depth.

        Raises:
            DataError: the axes are near parallel, or no camera looks at where they meet.
        """
        if self.parallel or not (self.ahead & ~self.stray).any():
            raise DataError(
                f"{where}: near and far cannot be estimated from {len(self.ahead)} cameras whose optical axes do not "
                "meet before them; set data.reader.near and data.reader.far, in units of the poses"
            )
        distances = self.distances[self.ahead & ~self.stray]
        radius = float(np.median(distances)) * math.sin(half_angle)
        nearest = float(distances.min())
        return max(nearest - radius, MIN_NEAR * nearest), float(distances.max()) + radius


def _astray(c2w: Float[np.ndarray, "views 4 4"]) -> Bool[np.ndarray, " views"]:
    """Mark cameras at a quite different distance than the others; none where they are too many."""
    if len(c2w) * MAX_STRAYS < 1:
        return np.zeros(len(c2w), bool)
    weights = np.ones(len(c2w))
    for _ in range(ROUNDS):  # a stray axis pulls a least-squares point, but hardly one of least distances
        point, across = closest_point(c2w, weights)
        misses = np.linalg.norm(np.einsum("vij,vj->vi", across, point - c2w[:, :3, 3]), axis=1)
        distances = np.linalg.norm(point - c2w[:, :3, 3], axis=1)
        middle = np.median(distances)
        if misses.max() < 1e-6 * middle:  # all axes meet
            break
        weights = 1 / np.maximum(misses, max(1e-6 * np.median(misses), 1e-12))
    stray = (distances > STRAY * middle) | (distances * STRAY < middle)
    return stray if stray.mean() <= MAX_STRAYS else np.zeros_like(stray)
