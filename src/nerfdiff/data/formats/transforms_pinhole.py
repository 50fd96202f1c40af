"""The intrinsics in a `transforms.json`: focal lengths in pixels, or a field of view."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.json_files import optional_number
from nerfdiff.data.formats.posed_files import ASPECT_TOLERANCE, is_focal
from nerfdiff.utils.errors import DataError


@dataclass(frozen=True)
class Pinhole:
    """A pinhole, for images of a stated size or of any.

    Args:
        where: file and frame, for messages.
        focal: (fl_x, fl_y) in pixels; None where the field of view is given.
        angle: (camera_angle_x, camera_angle_y) in radians; the second may be None: square pixels.
        centre: (cx, cy) in pixels; None is the middle of the image.
        size: (h, w) that focal and centre are for; None: that of the image, whatever it is.
    """

    where: str
    focal: tuple[float, float] | None
    angle: tuple[float, float | None] | None
    centre: tuple[float, float] | None
    size: tuple[float, float] | None

    @staticmethod
    def read(values: Mapping[str, Any], where: str) -> "Pinhole":
        """From the keys of a frame and, where it lacks them, of its file.

        Raises:
            DataError: there are no intrinsics, or they are no pinhole's.
        """
        keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
        fx, fy, cx, cy, w, h, angle_x, angle_y = (optional_number(values, key, where) for key in keys)
        if fx is None and angle_x is None:
            raise DataError(f"{where}: no intrinsics; expected 'fl_x' (pixels) or 'camera_angle_x' (radians)")
        for one, other, names in ((cx, cy, "'cx' and 'cy'"), (w, h, "'w' and 'h'")):
            if (one is None) != (other is None):
                raise DataError(f"{where}: of {names} one is missing; expected both or neither")
        focal = None if fx is None else (fx, fx if fy is None else fy)
        angle = None if fx is not None else (angle_x, angle_y)
        sizes = [1.0 if side is None else side for side in (w, h)]
        angles = [a for a in angle or () if a is not None]
        if min(focal or (1,)) <= 0 or min(sizes) < 1 or not all(0 < a < math.pi for a in angles):
            raise DataError(
                f"{where}: focal length {focal}, field of view {angle}, size {w}x{h}; expected positive numbers and an "
                "angle below π"
            )
        return Pinhole(where, focal, angle, None if cx is None else (cx, cy), None if w is None else (h, w))

    def K(self, height: int, width: int) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of an image stored at `height` × `width`, which may be another resolution than stated.

        Raises:
            DataError: the image has another aspect, its principal point lies outside, or no lens has the focal length.
        """
        stated = self.size or (height, width)
        sy, sx = height / stated[0], width / stated[1]
        if abs(sx / sy - 1) > ASPECT_TOLERANCE:
            raise DataError(
                f"{self.where}: intrinsics are for w x h = {stated[1]:g}x{stated[0]:g}, but the image is "
                f"{width}x{height}, of another aspect; expected those of the images as they are stored"
            )
        if self.focal is not None:
            fx, fy = self.focal[0] * sx, self.focal[1] * sy
        else:
            fx = width / 2 / math.tan(self.angle[0] / 2)
            fy = fx if self.angle[1] is None else height / 2 / math.tan(self.angle[1] / 2)
        cx, cy = (width / 2, height / 2) if self.centre is None else (self.centre[0] * sx, self.centre[1] * sy)
        if not (is_focal(fx, width) and is_focal(fy, width)):
            raise DataError(
                f"{self.where}: focal lengths of {fx:g} and {fy:g} pixels are no lens's in an image {width} wide; "
                "expected 'fl_x' and 'fl_y' in pixels"
            )
        if not (0 < cx < width and 0 < cy < height):
            raise DataError(
                f"{self.where}: the principal point ({cx:g}, {cy:g}) lies outside the image of {width}x{height}; "
                "expected 'cx' and 'cy' in pixels, and 'w' and 'h' where the images are stored at another resolution"
            )
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
