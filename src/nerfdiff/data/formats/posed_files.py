"""Poses and intrinsics in text files, and what every reader asks of them, wherever they were written."""

import codecs
import stat
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.utils.errors import DataError

RIGID_TOLERANCE = 1e-3
"""Largest deviation of R·Rᵀ from the identity that rounding in a text file explains."""
MAX_POSITION = 1e12
"""Coordinates whose powers single precision still holds."""
UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""Byte-order mark of a file that Windows PowerShell wrote, say."""
ASPECT_TOLERANCE = 0.02
"""Share by which the two scale factors may differ by rounding of the image size (640×480 stored as 107×80)."""
FOCAL_RANGE = (1e-3, 1e5)
"""Range of focal lengths relative to the image's width: fields of view of 179.9° and of 2 seconds of arc."""


def read_numbers(path: Path, counts: tuple[int, ...], what: str) -> Float[np.ndarray, " count"]:
    """Read all numbers of a text file, on however many lines.

    Raises:
        DataError: the file is missing, is no text of numbers, or holds another count than one of `counts`.
    """
    expected = f"expected {what}: {' or '.join(map(str, counts))} finite numbers"
    words = read_text(path, expected).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(f"{path}: {expected} ({error})") from error
    if len(numbers) not in counts:
        raise DataError(f"{path}: {expected}, found {len(numbers)}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{path}: {expected}, found NaN or infinity")
    return numbers


def read_text(path: Path, expected: str) -> str:
    """The file's text: UTF-8, or UTF-16 where a byte-order mark says so; without the mark.

    Raises:
        DataError: the file cannot be read; the message says what was `expected` in it.
    """
    try:
        require_file(path)
        content = path.read_bytes()
        return content.decode("utf-16" if content.startswith(UTF16_MARKS) else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {expected}, but it cannot be read ({error})") from error


def require_file(path: Path) -> None:
    """Refuse what would be waited for or read without end: pipes, sockets, devices.

    Raises:
        DataError: it is there, and no ordinary file.
        OSError: it is not there, or cannot be looked at.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # opening a folder fails by itself
        raise DataError(f"{path}: no ordinary file, but a pipe, socket or device; give a file")


def read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read a row-major rigid 4×4 matrix of 16 numbers.

    Raises:
        DataError: as `read_numbers`, or the matrix is not a rotation and a translation.
    """
    pose = read_numbers(path, (16,), "a row-major 4x4 pose").reshape(4, 4)
    check_rigid(pose, path)
    return pose


def check_rigid(pose: Float[np.ndarray, "4 4"], where: str | Path) -> None:
    """Refuse a matrix that is not a rotation and a translation.

    Args:
        where: the file, and the key within it, for the message.

    Raises:
        DataError: entries are NaN, infinite or huge, or the matrix scales, shears or mirrors.
    """
    if not np.isfinite(pose).all():
        raise DataError(f"{where}: expected a 4x4 pose of finite numbers, found NaN or infinity")
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    # negated, so that the NaN of an overflow is refused
    if not deviation <= RIGID_TOLERANCE or np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise DataError(
            f"{where}: the pose is not rigid (R·Rᵀ is off the identity by {deviation:.2g}, "
            f"last row {pose[3].tolist()}); expected a rotation and a translation, with no scale"
        )
    if np.linalg.det(rotation) < 0:
        raise DataError(f"{where}: the pose mirrors space (det R < 0); expected a right-handed rotation")
    if np.abs(pose[:3, 3]).max() > MAX_POSITION:
        raise DataError(
            f"{where}: the position {pose[:3, 3].tolist()} is too far from the origin for single precision; expected a "
            "world that is centred near the scene"
        )


def inverse_pose(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def is_focal(f: float, width: float) -> bool:
    """Return true if a lens can have a focal length of `f` pixels in images of this width."""
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
