"""The pictures of a run: where they lie, and small ones to carry within the page."""

import base64
import io
import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from PIL import Image

from nerfdiff.results.frame import Run

WEBP_QUALITY = 70


def links(run: Run, page: Path) -> dict[str, str]:
    """Relative links from the page's folder to the run's contact sheet, orbit video and folder, of those that exist.

    What lies outside of the results is not linked, wherever the row says that it is.
    """
    if (folder := run.file()) is None or not folder.is_dir():
        return {}
    found = {"folder": folder, "sheet": run.file("sheet.png"), "orbit": _orbit(run)}
    # a path that is no URL yet: `#` and `?` would end it, and other drives have no relative path
    return {
        name: quote(os.fsencode(Path(os.path.relpath(path, page)).as_posix()))
        for name, path in found.items()
        if path is not None
    }


def _orbit(run: Run) -> Path | None:
    """Return the orbit of all scenes, else that of the first."""
    predictions = run.file("predictions", str(run.row.strategy))
    if (own := run.file("orbit.mp4")) is not None or predictions is None:
        return own
    names = sorted(path.parent.name for path in predictions.glob("*/orbit.mp4"))
    paths = (run.file("predictions", str(run.row.strategy), name, "orbit.mp4") for name in names)
    return next((path for path in paths if path is not None), None)


@dataclass
class SmallSheets:
    """Contact sheets as data URLs, to carry within the page.

    Args:
        width, height: pixels that one has at most; of a longer one the top is shown.
        megabytes: that all have together at most; then there are no more.
        megapixels: a larger picture is not opened.
        warn: is told of sheets that cannot be shown.
    """

    width: int
    height: int
    megabytes: float
    megapixels: float
    warn: Callable[[str], object]

    def of(self, runs: Iterable[Run]) -> list[str | None]:
        """One per run; None where it is missing, damaged or too large, or there is no room: it is linked at best."""
        left = self.megabytes * 2**20
        sheets: list[str | None] = []
        for run in runs:
            path = run.file("sheet.png") if left > 0 else None
            sheet = None if path is None else self._small(path)
            left -= len(sheet or "")
            sheets.append(sheet if left > 0 else None)
        return sheets

    def _small(self, path: Path) -> str | None:
        try:
            if not path.is_file():
                raise OSError("it is no file")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is looked at here
                with Image.open(path, formats=("PNG",)) as image:
                    width, height = image.size
                    if width * height > self.megapixels * 1e6:
                        raise OSError(f"{width}×{height} pixels are more than pictures.megapixels={self.megapixels:g}")
                    image = image.convert("RGB")
                    image.thumbnail((self.width, height))
                    image = image.crop((0, 0, image.width, min(image.height, self.height)))
                    file = io.BytesIO()
                    image.save(file, "WEBP", quality=WEBP_QUALITY)
        except Exception as error:  # of whatever damage the decoder stumbles over
            self.warn(f"{path}: not shown: {error}")
            return None
        return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()
