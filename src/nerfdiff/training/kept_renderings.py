"""Renderings of a frozen field, rendered once and kept on disk for the many times that the CDM trains on them."""

import sqlite3
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.utils.errors import CheckpointError

SCHEMA = "CREATE TABLE IF NOT EXISTS checked (name TEXT PRIMARY KEY, pixels BLOB, crc INTEGER) WITHOUT ROWID"


class KeptRenderings:
    """8-bit images by name, in one SQLite file; several processes may share it.

    A name says which scene, source and target view were rendered, and the folder which field and data.

    Args:
        folder: of the file; made if missing.

    Raises:
        CheckpointError: the file cannot be opened, read or written.
    """

    def __init__(self, folder: str | Path):
        self.path = Path(folder) / "renderings.sqlite"
        self._open: sqlite3.Connection | None = None

    def __getstate__(self) -> dict:
        """Return the state without the open file, which neither a copy nor another process has."""
        return self.__dict__ | {"_open": None}

    @property
    def _file(self) -> sqlite3.Connection:
        if self._open is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._open = sqlite3.connect(self.path, timeout=60)
            self._open.execute("PRAGMA journal_mode=WAL")
            self._open.execute("PRAGMA synchronous=NORMAL")
            self._open.execute(SCHEMA)
        return self._open

    def get(
        self, names: Sequence[str], size: tuple[int, int], render: Callable[[list[int]], Float[Tensor, "missing 3 h w"]]
    ) -> Float[Tensor, "names 3 height width"]:
        """Return images in [0, 1], rounded to 8 bits.

        Args:
            size: height and width.
            render: makes the images at these positions of `names`, in [0, 1]; called once for all that are missing.
        """
        pixels = np.empty((len(names), 3, *size), np.uint8)
        missing = []
        try:
            for position, name in enumerate(names):
                found = self._file.execute("SELECT pixels, crc FROM checked WHERE name = ?", (name,)).fetchone()
                if found is None:
                    missing.append(position)
                else:
                    if zlib.crc32(found[0]) != found[1]:
                        raise ValueError(f"bytes of {name} changed since they were written")
                    pixels[position] = np.frombuffer(found[0], np.uint8).reshape(pixels.shape[1:])
            if missing:
                fresh = (render(missing).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
                pixels[missing] = fresh
                images = [image.tobytes() for image in fresh]
                rows = [(names[p], image, zlib.crc32(image)) for p, image in zip(missing, images, strict=True)]
                with self._file:
                    self._file.executemany("INSERT OR IGNORE INTO checked VALUES (?, ?, ?)", rows)
        except (OSError, sqlite3.Error, ValueError) as error:  # a ValueError: an image of another size, or damaged
            raise self._failed(error) from error
        return torch.from_numpy(pixels).float() / 255

    def _failed(self, error: Exception) -> CheckpointError:
        return CheckpointError(
            f"{self.path}: the kept renderings cannot be used ({error}); make room there, delete this folder (it is "
            "rendered anew), or set kept_renderings=null"
        )
