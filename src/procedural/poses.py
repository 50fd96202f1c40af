"""Cameras: OpenCV axes, cam2world, in a z-up world; those of SRN look at the origin.

numpy in float64, so that workers that render need not load PyTorch.
"""

import numpy as np
from jaxtyping import Float, Real

from nerfdiff.poses import look_at_origin

# SRN's renders: 131.25 px at 128 × 128 with the principal point in the middle.
FOCAL_PER_PIXEL = 131.25 / 128


def look_at(centre: Real[np.ndarray, "3"], target: Real[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """cam2world of a camera at `centre` that looks at `target`, otherwise as `look_at_origin`."""
    c2w = look_at_origin(np.asarray(centre, np.float64) - target)
    c2w[:3, 3] = centre
    return c2w


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


def rings(radius: int | float, views: int, elevations: tuple[int | float, ...]) -> Float[np.ndarray, "views 4 4"]:
    """Poses on circles of these elevations in degrees, in turn: each circle's are spread evenly."""
    around = -(-views // len(elevations))
    poses = []
    for view in range(views):
        elevation = np.radians(elevations[view % len(elevations)])
        azimuth = 2 * np.pi * (view // len(elevations)) / around
        across = np.cos(elevation)
        poses.append([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    return np.stack([look_at_origin(radius * np.array(direction)) for direction in poses])
