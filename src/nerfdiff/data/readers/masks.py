"""Mask files to foreground, and what tells that masks were misread."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Real
from PIL import Image

from nerfdiff.data.formats.images import open_image
from nerfdiff.data.readers.framing import Framing
from nerfdiff.utils.errors import DataError

FEW = 8
"""Up to so many levels an image shows labels rather than soft edges."""
MAX_SOFT = 0.25
"""Largest share of pixels between background and object that soft edges explain; photographs and depth have more."""
COLOURED = 32
"""Least difference of two channels that is colour, and no rounding of a JPEG."""


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Decode a mask: the object is where it is opaque, if anything is transparent, else where it is not black.

    Read are two levels of any depth, of which 0 is the background; soft edges between them, halved at the middle;
    one colour or several on black; and palettes, where the object is whatever has another index than 0. A palette of
    greys is an image of grey levels.

    Raises:
        DataError: the file is missing, truncated or no image, or it has other levels; the message says which.
    """
    image = open_image(path)
    if image.has_transparency_data:
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() < 255:  # many programs write an alpha that says nothing
            return _halved(alpha, f"{path}: a mask whose alpha", image.format)
    if image.mode == "P":
        return _indexed(image, path)
    if image.mode == "1":
        return np.asarray(image)
    if image.mode in ("L", "F") or image.mode.startswith("I"):
        return _halved(np.asarray(image), f"{path}: a mask that", image.format)
    colours = np.asarray(image.convert("RGB"))
    levels = colours.max(-1)
    if levels.min() > levels.max() / 8 and (levels - colours.min(-1)).max() > COLOURED:
        found = np.unique(colours.reshape(-1, 3), axis=0)
        raise DataError(
            f"{path}: a mask of {len(found)} colours, none of them black, first {found[:4].tolist()}; expected black "
            "where the background is"
        )
    return _halved(levels, f"{path}: a mask that", image.format)


def likely_misreading(masks: Sequence[Bool[np.ndarray, "_ _"]], max_border: float) -> str | None:
    """Say why the masks of a scene's views cannot be those of an object in them; None where they can.

    Args:
        max_border: share of its image's outermost pixels that a mask may cover; most masks of objects cover few.
    """
    if not any(mask.any() for mask in masks):
        return "the masks are empty in every view; the object may be marked in another channel, or by another level"
    if all(mask.all() for mask in masks):
        return "the masks cover all of every view; the background may be marked in another channel, or by another level"
    covering = sum(border(mask).mean() > max_border for mask in masks)
    if covering <= len(masks) / 2:
        return None
    return (
        f"the masks cover most of the border in {covering} of {len(masks)} views; they look inverted, white where the "
        "background is"
    )


def border(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, " outermost"]:
    """The outermost pixels of an image, each once."""
    outermost = np.ones(mask.shape, bool)
    outermost[1:-1, 1:-1] = False
    return mask[outermost]


def stacked_masks(
    masks: Sequence[Bool[np.ndarray, "_ _"] | None], framing: Framing, by_alpha: bool
) -> Bool[torch.Tensor, "views new_height new_width"] | None:
    """The views' framed masks; None where one of them has none.

    Args:
        by_alpha: masks are where images are opaque. None as well where all of every view is: that tells nothing.
    """
    if any(mask is None for mask in masks) or (by_alpha and all(mask.all() for mask in masks)):
        return None
    return torch.from_numpy(np.stack([framing.values(mask) for mask in masks]))


def _indexed(image: Image.Image, path: Path) -> Bool[np.ndarray, "height width"]:
    indices = np.asarray(image)
    palette = np.zeros((256, 3), np.uint8)
    stored = np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
    palette[: len(stored)] = stored
    used = np.unique(indices)
    colours = palette[used]
    if (colours == colours[:, :1]).all() and len(np.unique(colours[:, 0])) == len(used):
        return _halved(palette[indices, 0], f"{path}: a mask that", image.format)
    if palette[0].any() and not colours[used > 0].any(-1).all():
        raise DataError(
            f"{path}: a mask with the palette indices {_shown(used)}, of which not 0 but another is black; expected "
            "0 to be the background"
        )
    return indices > 0


def _halved(levels: Real[np.ndarray, "height width"], what: str, kind: str | None) -> Bool[np.ndarray, "height width"]:
    """Mark levels above half of the largest; any level but 0 where there is only one.

    Args:
        kind: of the file; that of JPEG alone has levels near those that were meant.
    """
    found = np.unique(levels)
    if not (np.isfinite(found).all() and found[0] >= 0):
        raise DataError(f"{what} has the levels {_shown(found)}; expected finite ones from 0 on")
    if len(found) == 1 or (len(found) == 2 and found[0] == 0):
        return levels > 0
    top = found[-1].astype(float)
    few = len(found) <= FEW and kind != "JPEG"
    between = (levels > (0 if few else top / 8)) & (levels < top * 7 / 8)
    if few and 2 * (between & ~(_near(levels == 0) & _near(levels >= top * 7 / 8))).sum() > between.sum():
        raise DataError(
            f"{what} has the levels {_shown(found)}; expected two, of which 0 is the background, and others only at "
            "their edge. Write 255 where the object is and 0 elsewhere, or a palette image, whose index 0 is the "
            "background"
        )
    if not few and between.mean() > MAX_SOFT:
        raise DataError(
            f"{what} has {len(found)} levels from {found[0]:g} to {found[-1]:g}, {between.mean():.0%} of the pixels "
            "between background and object; is it a mask? Expected 0 where the background is and 255 where the object "
            "is"
        )
    return levels > top / 2


def _near(where: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Within two pixels."""
    from skimage.morphology import dilation  # slow to import, and few masks have soft edges

    return dilation(where, np.ones((5, 5), bool))


def _shown(levels: Real[np.ndarray, " levels"]) -> str:
    shown = ", ".join(f"{level:g}" for level in levels[:FEW])
    return shown + (f" and {len(levels) - FEW} more" if len(levels) > FEW else "")
