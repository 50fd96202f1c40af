"""The two flavours of intrinsics in SRN-layout datasets."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.posed_files import ASPECT_TOLERANCE, check_K, is_focal, read_numbers, read_text
from nerfdiff.utils.errors import DataError


@dataclass(frozen=True)
class SceneIntrinsics:
    """`intrinsics.txt`: one pinhole for the whole scene, given for images of `height` × `width`.

    f cx cy _
    _ _ _
    _
    height width
    [1 where the pose files are world2cam, else 0]
    """

    path: Path
    f: float
    cx: float
    cy: float
    height: float
    width: float
    world2cam: bool

    @staticmethod
    def read(path: Path) -> "SceneIntrinsics":
        """Parse the file.

        Raises:
            DataError: it is not of the above form, or no pinhole has these numbers.
        """
        form = "expected intrinsics as lines 'f cx cy _', '_ _ _', '_', 'height width' and optionally '0' or '1'"
        lines = [line.split() for line in read_text(path, form).splitlines() if line.strip()]
        try:
            f, cx, cy = (float(word) for word in lines[0][:3])
            height, width = (float(word) for word in lines[3])
            world2cam = bool([["0"], ["1"]].index(lines[4])) if len(lines) > 4 else False
        except (IndexError, ValueError) as error:
            raise DataError(f"{path}: {form} ({error})") from error
        if not (0 < cx < width < np.inf and 0 < cy < height < np.inf and is_focal(f, width)):
            raise DataError(
                f"{path}: f = {f:g}, (cx, cy) = ({cx:g}, {cy:g}) and a size of {height:g}x{width:g} are no "
                "pinhole; expected f > 0 in pixels and a principal point inside the image"
            )
        return SceneIntrinsics(path, f, cx, cy, height, width, world2cam)

    def K(self, height: int, width: int) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of an image stored at `height` × `width`, which may be another resolution.

        Raises:
            DataError: the image is not the same view at another resolution.
        """
        sx, sy = width / self.width, height / self.height
        if abs(sx / sy - 1) > ASPECT_TOLERANCE:
            raise DataError(
                f"{self.path}: intrinsics are for {self.height:g}x{self.width:g}, but the images are "
                f"{height}x{width}, of another aspect; correct its line 'height width'"
            )
        return np.array([[self.f * sx, 0, self.cx * sx], [0, self.f * sy, self.cy * sy], [0, 0, 1]])


def read_view_intrinsics(path: Path, height: int, width: int) -> Float[np.ndarray, "3 3"]:
    """`intrinsics/<view>.txt`: a 3×3 K of the stored image.

    Raises:
        DataError: the numbers are no K of an image of `height` × `width`.
    """
    K = read_numbers(path, (9,), "a row-major 3x3 K").reshape(3, 3)
    check_K(K, height, width, path)
    return K
