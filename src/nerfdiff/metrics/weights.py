"""Weight files of metric networks that a person downloads once. Nothing here opens a connection."""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from nerfdiff.utils.errors import DataError
from nerfdiff.utils.hashes import sha256_file

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WeightsFile:
    """A published file.

    Args:
        url: where it is published; its last part is the file's name.
        sha256: the first digits of the file's hash (torch hub's convention: part of the name).
        column: the metric that cannot be measured without it.
        key: the config key that may name another place for it.
    """

    url: str
    sha256: str
    column: str
    key: str

    @property
    def name(self) -> str:
        return self.url.rsplit("/", 1)[-1]

    def find(self, path: str | Path | None = None) -> Path | None:
        """The file at `path`, or in torch hub's cache where `path` is None; None and one log line if absent.

        Raises:
            DataError: the file has another hash: other weights would give other numbers under the same name.
        """
        expected = Path(path) if path is not None else Path(torch.hub.get_dir()) / "checkpoints" / self.name
        if not expected.is_file():
            log.warning(
                "%s is left empty: its weights %s are not at %s. Download %s once and put it there, "
                "or set %s to its path.",
                *(self.column, self.name, expected, self.url, self.key),
            )
            return None
        digest = sha256_file(expected)
        if not digest.startswith(self.sha256):
            raise DataError(
                f"{expected} is not {self.name}: its SHA-256 starts with {digest[: len(self.sha256)]}, "
                f"expected {self.sha256}. It is damaged or another file: replace it by {self.url}"
            )
        return expected
