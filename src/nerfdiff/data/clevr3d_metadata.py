"""What Clevr3D's `metadata.npz` says of its scenes. An array is unpacked only when it is asked for."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nerfdiff.data.npz_files import read_array
from nerfdiff.errors import DataError


def camera_positions(metadata: Path) -> Float[np.ndarray, "scenes views 3"]:
    """`camera_pos` in single precision.

    Raises:
        DataError: the file is damaged, or the array missing or of another shape.
    """
    positions = read_array(metadata, "camera_pos", "[scenes, views, 3]")
    if positions.ndim != 3 or positions.shape[2] != 3 or 0 in positions.shape:
        raise DataError(f"{metadata}: expected camera_pos [scenes, views, 3], found shape {list(positions.shape)}")
    with np.errstate(over="ignore"):  # the reader refuses infinite positions with their scene's number
        return positions.astype(np.float32)


def object_counts(metadata: Path, scenes: int) -> Int[np.ndarray, " scenes"]:
    """How many of each scene's slots in `shape` hold an object; 0 is an empty slot.

    Raises:
        DataError: as `camera_positions`.
    """
    shape = read_array(metadata, "shape", f"[{scenes}, objects]")
    if shape.ndim != 2 or len(shape) != scenes:
        raise DataError(f"{metadata}: expected shape [{scenes}, objects], found shape {list(shape.shape)}")
    return (shape > 0).sum(1)
