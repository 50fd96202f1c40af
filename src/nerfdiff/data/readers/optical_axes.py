"""Detection of the camera convention, and of the point the cameras look at, from the poses alone."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.posed_files import check_rigid, inverse_pose
from nerfdiff.utils.errors import ConfigError, DataError

CONVENTIONS = ("auto", "opengl", "opencv")
RESIDUAL_TOLERANCE = 0.05
"""Largest distance (root mean square) between the optical axes and their intersection, relative to that of the
cameras, for cameras that look at one object. Exact look-at cameras stay below 1e-6; those of random axes, or of
matrices read the wrong way round, are near 1."""

log = logging.getLogger(__name__)
_reported: dict[Path, set[tuple[str, bool]]] = {}


@dataclass(frozen=True)
class ObjectCameras:
    """Cameras around one object.

    Args:
        c2w: camera-to-world with OpenCV axes, in the world of the file.
        centre: where the optical axes meet.
        convention: axes of the poses in the file: "opengl" (x right, y up, looking along −z) or "opencv".
        inverted: whether the matrices in the file are world-to-camera.
        residual: root mean square distance of the axes from `centre`, relative to `distance`.
        distance: mean distance of the cameras from `centre`.
    """

    c2w: Float[np.ndarray, "views 4 4"]
    centre: Float[np.ndarray, "3"]
    convention: str
    inverted: bool
    residual: float
    distance: float

    def normalised(self, distance: float) -> "ObjectCameras":
        """The same cameras with `centre` moved to the origin, scaled so that `distance` is their mean distance."""
        c2w = self.c2w.copy()
        c2w[:, :3, 3] = (c2w[:, :3, 3] - self.centre) * (distance / self.distance)
        return replace(self, c2w=c2w, centre=np.zeros(3), distance=distance)

    def describe(self) -> str:
        """Say in words what was found."""
        way = "world-to-camera" if self.inverted else "camera-to-world"
        names = {"opengl": "OpenGL/Blender", "opencv": "OpenCV"}
        return (
            f"{way} matrices with {names[self.convention]} axes; the optical axes meet at "
            f"({', '.join(f'{x:.4g}' for x in self.centre)}), off by {self.residual:.1e} of the cameras' mean "
            f"distance {self.distance:.4g}"
        )


def object_cameras(
    poses: Float[np.ndarray, "views 4 4"], convention: str, where: str | Path, names: tuple[str, ...]
) -> ObjectCameras:
    """Interpret poses of cameras that all look at one object.

    The axes meet at p in the least-squares sense. Cameras look along −z (OpenGL) where (p − C)·(−z) > 0, and
    along z (OpenCV) else. Where the axes do not meet, the inverse matrices are tried.

    Args:
        convention: "auto"; or "opengl" or "opencv", which poses are then required to be, camera-to-world.
        where: the file, for messages.
        names: of the views, for messages.

    Raises:
        DataError: a pose is not rigid, or the cameras do not look at one point, or look the other way than
            `convention` says.
    """
    for name, pose in zip(names, poses, strict=True):
        check_rigid(pose, f"{where}: view {name}")
    found = _meet(poses, inverted=False)
    if found is None and convention == "auto":
        found = _meet(np.stack([inverse_pose(pose) for pose in poses]), inverted=True)
    if found is None:
        tried = "neither as camera-to-world nor as world-to-camera do" if convention == "auto" else "do not"
        raise DataError(
            f"{where}: the optical axes of the {len(poses)} views {tried} meet in one point (within "
            f"{RESIDUAL_TOLERANCE:.0%} of the cameras' distance); expected at least two views that look at one object "
            "from different directions; check that poses are complete and belong to one object"
        )
    ahead = np.einsum("vi,vi->v", found.c2w[:, :3, 2], found.centre - found.c2w[:, :3, 3]) > 0
    if ahead.any() and not ahead.all():
        strays = [name for name, a in zip(names, ahead, strict=True) if a == (ahead.mean() < 0.5)]
        raise DataError(
            f"{where}: the views do not share one convention: {', '.join(strays[:8])} look the other way than the "
            f"rest along their z axes; expected all poses with OpenGL axes or all with OpenCV axes"
        )
    actual = "opencv" if ahead.all() else "opengl"
    if convention not in ("auto", actual):
        raise DataError(
            f"{where}: convention={convention}, but with these axes all cameras look away from where their "
            f"optical axes meet; set data.reader.convention to auto or {actual}"
        )
    c2w = found.c2w if actual == "opencv" else found.c2w * [1, -1, -1, 1]
    return replace(found, c2w=c2w, convention=actual)


def check_settings(near: float, far: float, distance: float, convention: str) -> None:
    """Refuse settings of a reader of such cameras that make no sense.

    Raises:
        ConfigError: an unknown convention, or bounds that do not enclose what is `distance` away.
    """
    if convention not in CONVENTIONS:
        raise ConfigError(f"convention {convention!r} is unknown; choose one of {', '.join(CONVENTIONS)}")
    if not 0 < near < distance < far:
        raise ConfigError(
            f"near = {near}, distance = {distance} and far = {far} must satisfy 0 < near < distance < far"
        )


def report(root: Path, found: ObjectCameras) -> None:
    """Log which convention the poses of a dataset have; once, and once more where scenes differ."""
    reported = _reported.setdefault(root, set())
    if (found.convention, found.inverted) in reported:
        return
    if reported:
        log.warning("%s: scenes differ in convention; here %s", root, found.describe())
    else:
        log.info("%s: %s", root, found.describe())
    reported.add((found.convention, found.inverted))


def closest_point(
    c2w: Float[np.ndarray, "views 4 4"], weights: Float[np.ndarray, " views"] | None = None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "views 3 3"]]:
    """The point closest to all optical axes (the z axes) in the least-squares sense; of no meaning where these are
    near parallel.

    Args:
        weights: of each axis's squared distance; None: all alike.

    Returns:
        the point p, and I − d dᵀ of each axis d: the distance of p from axis d through C is that of (I − d dᵀ)(p − C)
        from 0.
    """
    axes, centres = c2w[:, :3, 2], c2w[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weighted = across if weights is None else across * weights[:, None, None]
    return np.linalg.lstsq(weighted.sum(0), np.einsum("vij,vj->i", weighted, centres), rcond=None)[0], across


def _meet(c2w: Float[np.ndarray, "views 4 4"], inverted: bool) -> ObjectCameras | None:
    """Intersect the optical axes; None where they do not meet, or meet only at the cameras themselves."""
    centres = c2w[:, :3, 3]
    point, across = closest_point(c2w)
    if np.linalg.cond(across.sum(0)) > 1e10:  # parallel axes meet nowhere, or everywhere
        return None
    distance = np.linalg.norm(point - centres, axis=1).mean()
    # Inverted poses that look at the origin have their translations, and so their axes, in one place
    if distance < 1e-6 * np.abs(centres).max():
        return None
    misses = np.linalg.norm(np.einsum("vij,vj->vi", across, point - centres), axis=1)
    residual = float(np.sqrt((misses**2).mean()) / distance)
    if residual > RESIDUAL_TOLERANCE:
        return None
    return ObjectCameras(c2w.copy(), point, "", inverted, residual, float(distance))
