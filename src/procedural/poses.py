"""Cameras: OpenCV axes, cam2world, in a z-up world; those of SRN look at the origin.

numpy in float64, so that workers that render need not load torch.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Real

# SRN's renders: 131.25 px at 128 × 128 with the principal point in the middle.
FOCAL_PER_PIXEL = 131.25 / 128
SPIRAL_VIEWS = 251


def look_at_origin(centre: Sequence[int | float] | Real[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """cam2world of a camera at `centre` that looks at the origin, the world's z pointing up in the image.

    Straight above or below, where up is undefined, x is (−1, 0, 0): the limit SRN's own files hold.
    """
    centre = np.asarray(centre, np.float64)
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0.0, 0.0, 1.0])
    norm = np.linalg.norm(x)
    x = x / norm if norm > 1e-9 else np.array([-1.0, 0.0, 0.0])
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    c2w[:3, 3] = centre
    return c2w


def look_at(centre: Real[np.ndarray, "3"], target: Real[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """cam2world of a camera at `centre` that looks at `target`, otherwise as `look_at_origin`."""
    c2w = look_at_origin(np.asarray(centre, np.float64) - target)
    c2w[:3, 3] = centre
    return c2w


def srn_spiral(radius: int | float, views: int = SPIRAL_VIEWS) -> Float[np.ndarray, "views 4 4"]:
    """The first `views` of the 251 test poses of SRN-ShapeNet, from the equator up to the pole."""
    k = np.arange(views)
    elevation, azimuth = np.deg2rad(0.36 * k), 20 - 0.08 * k
    circle = np.cos(elevation)
    directions = np.stack([circle * np.cos(azimuth), circle * np.sin(azimuth), np.sin(elevation)], axis=1)
    return np.stack([look_at_origin(radius * d) for d in directions])


def random_sphere(
    radius: int | float,
    views: int,
    rng: np.random.Generator,
    elevation: tuple[int | float, int | float] = (-90.0, 90.0),
) -> Float[np.ndarray, "views 4 4"]:
    """Poses uniform on the sphere between two elevations in degrees; SRN's training views are on all of it."""
    low, high = np.sin(np.radians(elevation))
    # On a sphere the height is uniform (Archimedes).
    z = rng.uniform(low, high, views)
    azimuth = rng.uniform(0, 2 * np.pi, views)
    across = np.sqrt(1 - z**2)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
    return np.stack([look_at_origin(radius * d) for d in directions])
