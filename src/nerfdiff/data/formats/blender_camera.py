"""Blender's camera parameters to a pinhole in pixels."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.json_files import number
from nerfdiff.utils.errors import DataError

FITS = ("AUTO", "HORIZONTAL", "VERTICAL")


@dataclass(frozen=True)
class BlenderCamera:
    """A perspective camera with square pixels, as Blender's `bpy.types.Camera` describes it.

    One side of the image spans the sensor: the width (sensor_fit HORIZONTAL), the height (VERTICAL), or the longer
    one (AUTO). Blender's `angle_x` belongs to the sensor's width and `angle_y` to its height, whatever the image's
    shape; the one that does not fit the image is not looked at. AUTO uses the sensor's width for either side.

    Args:
        angle: full angle, in radians, under which the fitted side is seen.
        shift_x, shift_y: by how much the image is moved right and up, as a fraction of the fitted side.
        fit: one of FITS.
    """

    angle: float
    shift_x: float
    shift_y: float
    fit: str

    @staticmethod
    def of(values: Any, where: str | Path) -> "BlenderCamera":
        """From the keys angle_x, angle_y, shift_x, shift_y and sensor_fit; all but the angle may be left out.

        Raises:
            DataError: the angle is missing, or a value is none that a camera has; the message names the key.
        """
        fit = values.get("sensor_fit", "AUTO") if isinstance(values, dict) else "AUTO"
        if fit not in FITS:
            raise DataError(f"{where}: sensor_fit {fit!r} is unknown; expected one of {', '.join(FITS)}")
        key = "angle_y" if fit == "VERTICAL" else "angle_x"
        angle = number(values, key, where)
        if not 0 < angle < math.pi:
            raise DataError(f"{where}: {key} = {angle:g} is no field of view; expected radians between 0 and π")
        shifts = [number(values, shift, where, default=0.0) for shift in ("shift_x", "shift_y")]
        if max(map(abs, shifts)) > 0.5:
            raise DataError(f"{where}: shifts {shifts} put the principal point outside of the image")
        return BlenderCamera(angle, *shifts, fit)

    def K(self, height: int, width: int) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of an image of this size (pixel centres at +0.5)."""
        fitted = {"HORIZONTAL": width, "VERTICAL": height, "AUTO": max(height, width)}[self.fit]
        f = fitted / (2 * math.tan(self.angle / 2))
        # moving the image to the right leaves the optical centre on its left; v points down
        cx, cy = width / 2 - self.shift_x * fitted, height / 2 + self.shift_y * fitted
        return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
