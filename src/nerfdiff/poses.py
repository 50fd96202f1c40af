"""Poses in a z-up world that look at its origin: cam2world, OpenCV axes, float64.

numpy alone, so that processes that render scenes need not load PyTorch.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Real

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


def srn_spiral(radius: int | float, views: int = SPIRAL_VIEWS) -> Float[np.ndarray, "views 4 4"]:
    """The first `views` of the 251 test poses of SRN-ShapeNet, from the equator up to the pole."""
    k = np.arange(views)
    elevation, azimuth = np.deg2rad(0.36 * k), 20 - 0.08 * k
    circle = np.cos(elevation)
    directions = np.stack([circle * np.cos(azimuth), circle * np.sin(azimuth), np.sin(elevation)], axis=1)
    return np.stack([look_at_origin(radius * d) for d in directions])
