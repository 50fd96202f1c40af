"""What every reader asks of intrinsics, wherever they were written."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.errors import DataError

ASPECT_TOLERANCE = 0.02
"""How far the two scale factors may differ by rounding of the image size (640×480 stored as 107×80)."""
FOCAL_RANGE = (1e-3, 1e5)
"""Of focal lengths relative to the image's width: fields of view of 179.9° and of 2 seconds of arc."""


def is_focal(f: float, width: float) -> bool:
    """Whether a lens can have a focal length of `f` pixels in images of this width."""
    return bool(FOCAL_RANGE[0] * width < f < FOCAL_RANGE[1] * width)


def check_K(K: Float[np.ndarray, "3 3"], height: int, width: int, where: str | Path) -> None:
    """Refuse a matrix that is no K of a stored image of `height` × `width`.

    Args:
        where: the file, and the view within it, for the message.

    Raises:
        DataError: K is skewed, or has focal lengths or a principal point that no such image has.
    """
    pinhole = is_focal(K[0, 0], width) and is_focal(K[1, 1], width) and 0 < K[0, 2] < width and 0 < K[1, 2] < height
    if not pinhole or K[0, 1] or K[1, 0] or not np.array_equal(K[2], [0, 0, 1]):
        raise DataError(
            f"{where}: {K.tolist()} is no K of a {height}x{width} image; expected [[fx, 0, cx], [0, fy, cy], "
            "[0, 0, 1]] in pixels with a principal point inside the image"
        )
