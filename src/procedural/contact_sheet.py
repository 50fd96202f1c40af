"""One picture that shows what a generated data set looks like."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nerfdiff.data.formats.images import decode
from nerfdiff.utils.files import atomic


def contact_sheet(images: Sequence[Sequence[Path]], scenes: int, views: int) -> UInt8[np.ndarray, "height width 3"]:
    """Rows are scenes spread evenly over all, columns views spread evenly over each scene's `images`."""
    rows = [[decode(path) for path in _spread(paths, views)] for paths in _spread(images, scenes)]
    cut = _margin([image for row in rows for image in row])
    height, width = rows[0][0].shape[:2]
    strips = [np.concatenate([image[cut : height - cut, cut : width - cut] for image in row], axis=1) for row in rows]
    widest = max(strip.shape[1] for strip in strips)
    strips = [np.pad(s, ((0, 0), (0, widest - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    return np.concatenate(strips)


def _margin(images: Sequence[UInt8[np.ndarray, "height width 3"]]) -> int:
    """Count the pixels along all four borders that are white in every image, but for one."""
    drawn = np.any([(image < 255).any(axis=-1) for image in images], axis=0)
    if not drawn.any():
        return 0
    filled = [np.flatnonzero(drawn.any(axis=axis)) for axis in (1, 0)]
    free = [min(f.min(), size - 1 - f.max()) for f, size in zip(filled, drawn.shape, strict=True)]
    return int(max(0, min(free) - 1))


def write_contact_sheet(root: Path, images: Sequence[Sequence[Path]], scenes: int, views: int) -> Path | None:
    """Write `<root>/contact_sheet.png` of each scene's `images`; None where there is nothing to show."""
    if not images:
        return None
    path = Path(root) / "contact_sheet.png"
    with atomic(path) as temporary:
        Image.fromarray(contact_sheet(images, scenes, views)).save(temporary)
    return path


def _spread(items: Sequence, count: int) -> list:
    """At most `count` of `items`, evenly apart, first and last included."""
    picks = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in picks]
