"""Framed images of several views to one tensor."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from nerfdiff.errors import DataError


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
