"""Image files to 8-bit RGB on white, and their resizing."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8
from PIL import Image, ImageOps, UnidentifiedImageError
from PIL.ExifTags import Base

from nerfdiff.data.formats.posed_files import ASPECT_TOLERANCE, require_file
from nerfdiff.utils.errors import DataError

MAX_PIXELS = 64_000_000
"""Most pixels of an image; each takes some 25 bytes of memory until it is resized."""
READ_FORMATS = {b"\x89PNG": "PNG", b"\xff\xd8\xff": "JPEG", b"RIFF": "WebP"}
"""First bytes of what most images are: one of these that Pillow does not know is damaged."""
log = logging.getLogger(__name__)


def decode(path: Path, size: tuple[float, float] | None = None) -> UInt8[np.ndarray, "height width 3"]:
    """Decode grey, palette, RGB or RGBA, 8 or 16 bits deep (of 16 the upper 8 are kept); alpha lies on white.

    Where EXIF says that the stored pixels are to be turned, they are left as they are if they have the aspect that the
    image's camera states, and turned if only the upright picture has it.

    Args:
        size: (height, width) of the images that the camera is for, at whatever resolution; None: not stated.

    Raises:
        DataError: the file is missing, truncated or no image, or the camera does not tell which way up it is.
    """
    return decode_with_alpha(path, size)[0]


def decode_with_alpha(
    path: Path, size: tuple[float, float] | None = None, upright: bool = False
) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"] | None]:
    """`decode`, and where the image is more than half opaque; None where it has no transparency.

    Args:
        upright: turn the image as EXIF says, whatever `size` is.

    Raises:
        DataError: as `decode`.
    """
    image = open_image(path)
    image = ImageOps.exif_transpose(image) if upright else _as_its_camera_has_it(image, path, size)
    if image.mode == "F":
        raise DataError(f"{path}: its pixels are floating-point numbers; save it with 8 or 16 bits per channel")
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip rather than scale
        levels = np.asarray(image)
        if not 0 <= levels.min() <= levels.max() < 2**16:
            raise DataError(
                f"{path}: grey levels from {levels.min()} to {levels.max()}; save it with 8 or 16 bits per channel"
            )
        grey = (levels >> 8).astype(np.uint8)
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


def upright_size(path: Path) -> tuple[int, int]:
    """(height, width) of the image turned as EXIF says, by the file's header.

    Raises:
        DataError: the file is missing or no image.
    """
    with _readable(path), Image.open(path) as image:
        size = image.height, image.width
        return size[::-1] if image.getexif().get(Base.Orientation) in (5, 6, 7, 8) else size


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

    Rounded once, ties to even, so that no image becomes lighter. The image's borders stay where they are, as
    `Cameras.resized` assumes.
    """
    if image.shape[:2] == tuple(size):
        return image
    whole = all(old % new == 0 for old, new in zip(image.shape, size, strict=False))
    kernel = Image.Resampling.BOX if whole else Image.Resampling.BILINEAR
    # On 8 bits Pillow rounds after each axis, ties up: 0.5 of 255 levels too light by a factor of 2
    channels = [Image.fromarray(channel).resize((size[1], size[0]), kernel) for channel in _channels(image)]
    return np.rint(np.stack([np.asarray(channel) for channel in channels], -1)).astype(np.uint8)


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


def _channels(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "3 height width"]:
    return np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)


def _as_its_camera_has_it(image: Image.Image, path: Path, size: tuple[float, float] | None) -> Image.Image:
    orientation = image.getexif().get(Base.Orientation)
    if orientation not in range(2, 9):
        return image
    stored = (image.height, image.width)
    upright = stored[::-1] if orientation > 4 else stored
    if size is not None:
        fits = [shape == tuple(size) for shape in (stored, upright)]
        if not any(fits):
            aspects = [shape[1] * size[0] / (shape[0] * size[1]) for shape in (stored, upright)]
            fits = [abs(aspect - 1) <= ASPECT_TOLERANCE for aspect in aspects]
        if all(fits):
            _warn_of_orientation(path.parent, orientation)
        if any(fits):
            return image if fits[0] else ImageOps.exif_transpose(image)
    of = "no size" if size is None else f"w x h = {size[1]:g}x{size[0]:g}"
    raise DataError(
        f"{path}: its EXIF tag Orientation is {orientation} (stored as {stored[1]}x{stored[0]}, upright "
        f"{upright[1]}x{upright[0]}) and its camera states {of}, so that it is not known which of the two the camera "
        "is for; state the size (in a transforms.json 'w' and 'h'), or save the image that the camera is for without "
        "the tag"
    )


@lru_cache
def _warn_of_orientation(folder: Path, orientation: int) -> None:
    log.warning(
        "%s: its images have an EXIF tag Orientation of %d, and their size does not tell whether the cameras are for "
        "the stored or for the upright ones; the stored ones are used",
        folder,
        orientation,
    )


def open_image(path: Path) -> Image.Image:
    """The decoded image as Pillow has it.

    Raises:
        DataError: as `decode`.
    """
    with _readable(path), Image.open(path) as image:
        if image.height * image.width > MAX_PIXELS:
            raise DataError(
                f"{path}: {image.height}x{image.width} are {image.height * image.width / 1e6:.0f} million pixels, "
                f"expected at most {MAX_PIXELS / 1e6:.0f} million; save it smaller"
            )
        image.load()
        return image


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn Pillow's errors on missing and damaged files into one that names the file."""
    try:
        require_file(path)
        yield
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such image") from error
    except UnidentifiedImageError as error:
        raise DataError(f"{path}: {_unidentified(path)}") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = str(error).replace(str(path), "it").replace(repr(str(path)), "it")
        raise DataError(f"{path}: not a whole image ({reason}); copy or render it anew") from error


def _unidentified(path: Path) -> str:
    """Say what is wrong with a file that Pillow does not know, and what to do."""
    with open(path, "rb") as file:
        head = file.read(64)
    damaged = [name for first, name in READ_FORMATS.items() if head.startswith(first)]
    if not head or damaged:
        return f"not a whole image ({'empty' if not head else f'a damaged {damaged[0]}'}); copy or render it anew"
    if head.startswith(b"version https://git-lfs"):
        return "not the image, but Git LFS's pointer to it; fetch it with git lfs pull"
    if head[4:8] == b"ftyp":  # HEIC, AVIF, MP4 and their kin
        found = repr(head[8:12].decode("ascii", "replace"))
    else:
        found = f"one that begins with {head[:8]!r}"
    return f"an image of an unsupported format ({found}), or none; convert it to PNG, JPEG or WebP"
