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
        row = [np.asarray(Image.open(path).convert("RGB")) for path in _spread(images, views)]
        rows.append(np.concatenate(row, axis=1))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    return np.concatenate(rows)


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
