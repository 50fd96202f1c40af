"""Image files to 8-bit RGB on white, and their resizing."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8
from PIL import Image

from nerfdiff.errors import DataError


def decode(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Decode grey, palette, RGB or RGBA, 8 or 16 bits deep (of 16 the upper 8 are kept); alpha lies on white.

    Raises:
        DataError: the file is missing, truncated or no image.
    """
    return decode_with_alpha(path)[0]


def decode_with_alpha(
    path: Path,
) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"] | None]:
    """`decode`, and where the image is more than half opaque; None where it has no transparency.

    Raises:
        DataError: as `decode`.
    """
    image = open_image(path)
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip rather than scale
        grey = (np.asarray(image) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1), None
    if not image.has_transparency_data:
        return np.asarray(image.convert("RGB")), None
    rgba = np.asarray(image.convert("RGBA"))
    colour, alpha = rgba[..., :3].astype(np.uint16), rgba[..., 3:].astype(np.uint16)
    return ((colour * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8), rgba[..., 3] > 127


def stored_size(path: Path) -> tuple[int, int]:
    """(height, width) by the file's header, without decoding.

    Raises:
        DataError: the file is missing or no image.
    """
    with _readable(path), Image.open(path) as image:
        return image.height, image.width


def decode_levels(path: Path) -> Integer[np.ndarray, "height width"]:
    """Decode the one channel of an image as it is stored: labels, palette indices, or depths of 16 bits.

    Raises:
        DataError: as `decode`, or the image has several channels or no whole numbers.
    """
    image = open_image(path)
    levels = np.asarray(image)
    if levels.dtype == bool:
        levels = levels.astype(np.uint8)
    if levels.ndim != 2 or not np.issubdtype(levels.dtype, np.integer):
        raise DataError(f"{path}: expected an image of one channel of whole numbers, found mode {image.mode}")
    return levels


def resize(
    image: UInt8[np.ndarray, "height width 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "new_height new_width 3"]:
    """Resize to (height, width) without aliasing: exact area averages by whole factors, else a tent filter.

    The image's borders stay where they are, as `Cameras.resized` assumes.
    """
    if image.shape[:2] == tuple(size):
        return image
    whole = all(old % new == 0 for old, new in zip(image.shape, size, strict=False))
    kernel = Image.Resampling.BOX if whole else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(image).resize((size[1], size[0]), kernel))


def resize_nearest(
    values: Float[np.ndarray, "height width"] | Bool[np.ndarray, "height width"], size: tuple[int, int]
) -> Float[np.ndarray, "new_height new_width"] | Bool[np.ndarray, "new_height new_width"]:
    """Resize depth or masks, whose values must not be averaged over an edge: each new pixel takes the value whose
    centre is nearest to its own.

    By an even factor the new centre lies on the border of two old pixels, of which the right or lower one is taken:
    no choice of stored values avoids that half an old pixel, and this one is the same at every pixel.
    """
    rows, columns = ((2 * np.arange(new) + 1) * old // (2 * new) for new, old in zip(size, values.shape, strict=True))
    return values[rows[:, None], columns]


def open_image(path: Path) -> Image.Image:
    """The decoded image as Pillow has it.

    Raises:
        DataError: as `decode`.
    """
    with _readable(path), Image.open(path) as image:
        image.load()
        return image


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """What Pillow raises on missing and damaged files, as one error that names the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such image") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = str(error).replace(str(path), "it").replace(repr(str(path)), "it")
        raise DataError(f"{path}: not a whole image ({reason}); copy or render it anew") from error
