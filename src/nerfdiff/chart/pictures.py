"""The pictures of a run: where they lie, and small ones to carry within the page."""

import base64
import io
import os
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote

from PIL import Image

from nerfdiff.results.frame import Run

WEBP_QUALITY = 70


def links(run: Run, page: Path) -> dict[str, str]:
    """Relative links from the page's folder to the run's contact sheet, orbit video and folder, of those that exist."""
    if run.folder is None or not run.folder.is_dir():
        return {}
    found = {"folder": run.folder, "sheet": run.folder / "sheet.png", "orbit": _orbit(run)}
    # a path that is no URL yet: `#` and `?` would end it, and other drives have no relative path
    return {
        name: quote(Path(os.path.relpath(path, page)).as_posix())
        for name, path in found.items()
        if path is not None and path.exists()
    }


def _orbit(run: Run) -> Path | None:
    """Of the first scene, where the run has none of all."""
    own = run.folder / "orbit.mp4"
    if own.is_file():
        return own
    return next(iter(sorted((run.folder / "predictions" / str(run.row.strategy)).glob("*/orbit.mp4"))), None)


def small_sheets(runs: Iterable[Run], width: int, megabytes: float) -> list[str | None]:
    """Contact sheets of `width` pixels at most as data URLs, until they take `megabytes` together; then None.

    A sheet that is missing or damaged is None too: it is linked at best.
    """
    left = megabytes * 2**20
    sheets: list[str | None] = []
    for run in runs:
        sheet = _small(run.folder / "sheet.png", width) if left > 0 and run.folder is not None else None
        left -= len(sheet or "")
        sheets.append(sheet if left > 0 else None)
    return sheets


def _small(path: Path, width: int) -> str | None:
    try:
        with Image.open(path) as image:
            image = image.convert("RGB")
            image.thumbnail((width, 4 * width))
            file = io.BytesIO()
            image.save(file, "WEBP", quality=WEBP_QUALITY)
    except OSError:
        return None
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()
