"""Cropping and resizing of stored images; images, truth and intrinsics change together."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerfdiff.data.formats import images
from nerfdiff.utils.errors import ConfigError, DataError


def stack_pixels(
    images: Sequence[UInt8[np.ndarray, "height width 3"]], files: Sequence[Path]
) -> UInt8[Tensor, "views 3 height width"]:
    """Stack images of one size.

    Raises:
        DataError: an image has another size than the first; the message names its file.
    """
    height, width = images[0].shape[:2]
    for image, file in zip(images, files, strict=True):
        if image.shape != images[0].shape:
            raise DataError(
                f"{file}: {image.shape[0]}x{image.shape[1]} pixels, other views of the scene have "
                f"{height}x{width}; set data.image_size to resize all"
            )
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()


@dataclass(frozen=True)
class Framing:
    """A centred crop, then a resize.

    Args:
        crop: (height, width) in stored pixels of the part around the image's centre to keep; None keeps all.
        size: (height, width) to resize to; None keeps the pixels.
    """

    crop: tuple[int, int] | None
    size: tuple[int, int] | None

    @staticmethod
    def of(crop: int | Sequence[int] | None, image_size: int | Sequence[int] | None) -> "Framing":
        """From config values: a side in pixels, [height, width], or None.

        Raises:
            ConfigError: a value is none of these.
        """
        return Framing(_height_width(crop, "crop"), _height_width(image_size, "image_size"))

    def image(self, pixels: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "new_height new_width 3"]:
        """Crop and resize colours, without aliasing.

        Raises:
            DataError: the image is smaller than the crop.
        """
        pixels = self._cropped(pixels)
        return pixels if self.size is None else images.resize(pixels, self.size)

    def values(
        self, values: Float[np.ndarray, "height width"] | Bool[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "new_height new_width"] | Bool[np.ndarray, "new_height new_width"]:
        """Crop and resize depth or a mask, whose values must not be averaged over an edge.

        Raises:
            DataError: as `image`.
        """
        values = self._cropped(values)
        return values if self.size is None else images.resize_nearest(values, self.size)

    def K(self, K: Float[np.ndarray, "3 3"], height: int, width: int) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of the framed image, from those of the stored one of `height` × `width`."""
        top, left, rows, columns = self._window(height, width)
        K = np.array(K, dtype=np.float64)
        K[:2, 2] -= left, top
        if self.size is not None:
            K[0] *= self.size[1] / columns
            K[1] *= self.size[0] / rows
        return K

    def _cropped(self, array: np.ndarray) -> np.ndarray:
        top, left, height, width = self._window(*array.shape[:2])
        return array[top : top + height, left : left + width]

    def _window(self, height: int, width: int) -> tuple[int, int, int, int]:
        """(top, left, height, width) of what is kept."""
        if self.crop is None:
            return 0, 0, height, width
        if self.crop[0] > height or self.crop[1] > width:
            raise DataError(
                f"a crop of {self.crop[0]}x{self.crop[1]} does not fit into images of {height}x{width}; make "
                "data.reader.crop smaller, or null"
            )
        return (height - self.crop[0]) // 2, (width - self.crop[1]) // 2, *self.crop


def _height_width(value: int | Sequence[int] | None, key: str) -> tuple[int, int] | None:
    if value is None:
        return None
    size = (value, value) if isinstance(value, int) else tuple(value)
    if len(size) != 2 or not all(isinstance(side, int) and side > 0 for side in size):
        raise ConfigError(f"{key} {value!r} is neither a side in pixels nor [height, width]")
    return size
