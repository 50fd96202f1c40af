"""One picture that shows what a generated data set looks like."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def contact_sheet(folders: Sequence[Path], scenes: int, views: int) -> UInt8[np.ndarray, "height width 3"]:
    """Rows are scenes spread evenly over `folders`, columns views spread evenly over each scene."""
    rows = []
    for folder in _spread(folders, scenes):
        images = sorted((folder / "rgb").glob("*.png"))
        rows.append([np.asarray(Image.open(path).convert("RGB")) for path in _spread(images, views)])
    low, high = _occupied([image for row in rows for image in row])
    strips = [np.concatenate([image[low:high, low:high] for image in row], axis=1) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    strips = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    return np.concatenate(strips)


def _occupied(images: Sequence[UInt8[np.ndarray, "size size 3"]]) -> tuple[int | np.integer, int | np.integer]:
    """The central square outside which every image is white, as a range of rows and columns."""
    size = images[0].shape[0]
    drawn = np.any([(image < 255).any(axis=-1) for image in images], axis=0)
    filled = np.flatnonzero(drawn.any(axis=0) | drawn.any(axis=1))
    margin = max(0, min(filled.min(), size - 1 - filled.max()) - 1) if filled.size else 0
    return margin, size - margin


def write_contact_sheet(root: Path, folders: Sequence[Path], scenes: int, views: int) -> Path | None:
    """Write `<root>/contact_sheet.png`; None where there is nothing to show."""
    if not folders:
        return None
    path = Path(root) / "contact_sheet.png"
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    Image.fromarray(contact_sheet(folders, scenes, views)).save(temporary, format="PNG")
    os.replace(temporary, path)
    return path


def _spread(items: Sequence, count: int) -> list:
    """At most `count` of `items`, evenly apart, first and last included."""
    picks = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in picks]
