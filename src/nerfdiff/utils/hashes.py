"""Digests that identify what a result came from."""

import hashlib
import json
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from nerfdiff.utils.errors import DataError


def sha256_values(values: Any) -> str:
    """SHA-256 of a config (Hydra's or plain) or any JSON values; the order of keys does not matter.

    Interpolations are resolved first, so that equal settings have equal digests however they are written.
    """
    if OmegaConf.is_config(values):
        values = OmegaConf.to_container(values, resolve=True)
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file's content.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
