"""Lens distortion of perspective cameras, taken out of images as they are read."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from nerfdiff.data.formats.json_files import optional_number
from nerfdiff.utils.errors import DataError

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
"""Camera models whose distortion, if they have any, is that of `Lens`."""
UNDISTORT = (
    "undistort the images (COLMAP's image_undistorter does, and gives the new intrinsics) and write the file for these"
)
MIN_SEEN = 0.5
"""Least share of an undistorted image that the stored one shows: below it no lens has these coefficients."""
FOLD_STEPS = 4096
"""Steps in radius of the search for where distortion folds the image over: finer than pixels."""


@dataclass(frozen=True)
class Lens:
    """Radial and tangential distortion, in nerfstudio's meaning of the names.

    A point at (x, y) on the plane z = 1, with r² = x² + y², is seen at

        x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²)
        y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2 y²) + 2 p2 x y

    which is OpenCV's model but for k4, there the first of three in a denominator.

    Args:
        where: file and frame, for messages.
        radial: (k1, k2, k3, k4).
        tangential: (p1, p2).
    """

    where: str
    radial: tuple[float, float, float, float]
    tangential: tuple[float, float]

    @staticmethod
    def read(values: Mapping[str, Any], where: str) -> "Lens | None":
        """From the keys of a frame and, where it lacks them, of its file; None where nothing is distorted.

        Raises:
            DataError: the camera is a fisheye or another that is not perspective, or has coefficients of a denominator.
        """
        models = [values.get(key) for key in ("camera_model", "camera_type")]
        others = [repr(m)[:80] for m in models if m is not None and str(m).upper() not in PERSPECTIVE]
        if others or values.get("is_fisheye"):
            shown = others[0] if others else "a fisheye"
            raise DataError(f"{where}: the camera is {shown}, only perspective ones are read; {UNDISTORT}")
        k1, k2, k3, k4, k5, k6, p1, p2 = (
            optional_number(values, key, where) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
        )
        if k5 or k6:
            raise DataError(
                f"{where}: k5 = {k5:g} and k6 = {k6:g} belong to a rational distortion, only polynomials (k1 to k4, "
                f"p1, p2) are read; {UNDISTORT}"
            )
        return Lens(where, (k1, k2, k3, k4), (p1, p2)) if any((k1, k2, k3, k4, p1, p2)) else None

    def image(self, pixels: UInt8[np.ndarray, "height width 3"], K: np.ndarray) -> UInt8[np.ndarray, "height width 3"]:
        """Resample to the image of a pinhole with the same K, bilinear; beyond the stored image its border goes on.

        Raises:
            DataError: the coefficients leave less than half of the image.
        """
        seen = self._remapped(torch.from_numpy(pixels.copy()).movedim(-1, 0), K, "bilinear", "border")
        return seen.round().to(torch.uint8).movedim(0, -1).numpy()

    def mask(self, mask: Bool[np.ndarray, "height width"], K: np.ndarray) -> Bool[np.ndarray, "height width"]:
        """The mask of `image`, by the nearest stored value; False beyond the stored mask.

        Raises:
            DataError: as `image`.
        """
        inside = self._map(K, *mask.shape)[2].numpy()
        return (self._remapped(torch.from_numpy(mask)[None], K, "nearest", "zeros")[0].numpy() > 0.5) & inside

    def _remapped(
        self, values: Tensor, K: np.ndarray, mode: str, padding: str
    ) -> Float32[Tensor, "channels height width"]:
        from kornia.geometry import remap  # takes two seconds, and few captures need it

        u, v, _ = self._map(K, *values.shape[-2:])
        return remap(values[None].float(), u[None], v[None], mode, padding, align_corners=True)[0]

    def _map(
        self, K: np.ndarray, height: int, width: int
    ) -> tuple[Float32[Tensor, "height width"], Float32[Tensor, "height width"], Bool[Tensor, "height width"]]:
        maps = _sampling_map(self.radial, self.tangential, (*K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), height, width))
        seen = maps[2].double().mean().item()
        if seen < MIN_SEEN:
            raise DataError(
                f"{self.where}: with k1, k2, k3, k4 = {self.radial} and p1, p2 = {self.tangential} the images show "
                f"{seen:.0%} of what their pinhole sees; no lens has such coefficients; {UNDISTORT}"
            )
        return maps


@lru_cache(maxsize=2)
def _sampling_map(
    radial: tuple[float, ...], tangential: tuple[float, float], camera: tuple[float, ...]
) -> tuple[Float32[Tensor, "height width"], Float32[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Find each undistorted pixel's place in the stored image, in kornia's pixels, and whether it has one.

    Frames of one camera share the map, which takes longer than its use.
    """
    from kornia.geometry import distort_points

    fx, fy, cx, cy, height, width = camera
    k1, k2, k3, k4 = radial
    grid = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    # kornia, as OpenCV, has the centre of the first pixel at 0 where K has it at 0.5
    x, y = (grid[1] + 0.5 - cx) / fx, (grid[0] + 0.5 - cy) / fy
    r = torch.hypot(x, y)
    fold = _fold(radial, r.max().item())
    # Past the fold the polynomial comes back into the image and would show it a second time
    shrink = (fold / r.clamp_min(1e-12)).clamp_max(1)
    x, y = x * shrink, y * shrink
    points = torch.stack([x, y], -1).reshape(-1, 2)
    dist = torch.tensor([k1, k2, *tangential, k3], dtype=torch.float64)
    seen = distort_points(points, torch.eye(3, dtype=torch.float64), dist)
    seen = seen + points * k4 * points.square().sum(-1, keepdim=True) ** 4
    u, v = seen[:, 0] * fx + cx - 0.5, seen[:, 1] * fy + cy - 0.5
    u, v = u.reshape(height, width), v.reshape(height, width)
    inside = (r < fold) & (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    u, v = (torch.nan_to_num(x, -1).clamp(-1, side).float() for x, side in ((u, width), (v, height)))
    return u, v, inside


def _fold(radial: tuple[float, ...], largest: float) -> float:
    """First radius on the plane z = 1 at which r + k1 r³ + … no longer grows; infinity if none up to `largest`."""
    radii = np.linspace(0, largest, FOLD_STEPS)
    with np.errstate(over="ignore", invalid="ignore"):
        slope = 1 + sum((2 * n + 1) * k * radii ** (2 * n) for n, k in enumerate(radial, start=1))
    folded = ~(slope > 0)  # NaN of an overflow counts
    return float(radii[folded.argmax()]) if folded.any() else math.inf
