"""Arrays in npz files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.posed_files import require_file
from nerfdiff.utils.errors import DataError


def read_array(path: Path, key: str, expected: str) -> np.ndarray:
    """One array of real numbers; the others of the file are not unpacked.

    Args:
        expected: the array's axes, for the message.

    Raises:
        DataError: the file is missing or damaged, or has no such array of numbers.
    """
    try:
        require_file(path)
        arrays = np.load(path)
        if isinstance(arrays, np.ndarray):
            raise ValueError("it is a single array")
        with arrays:
            array = arrays[key]
    except DataError:
        raise
    except Exception as error:  # damaged bytes surface as whatever zipfile, zlib or NumPy trips over
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: expected an npz file with an array '{key}' {expected} ({reason})") from error
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise DataError(f"{path}: expected numbers in '{key}' {expected}, found {array.dtype}")
    return array


def read_depth(path: Path) -> Float[np.ndarray, "height width"]:
    """The array `depth` of generated scenes: distance along z, 0 where nothing was hit.

    Raises:
        DataError: as `read_array`, or it is no finite depth of at least 0.
    """
    depth = read_array(path, "depth", "[height, width]").astype(np.float32)
    if depth.ndim != 2 or not (np.isfinite(depth) & (depth >= 0)).all():
        raise DataError(f"{path}: expected a finite [height, width] depth of at least 0, found shape {depth.shape}")
    return depth
