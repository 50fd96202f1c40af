"""Uses of the fused kernels that agreed with the reference, kept on disk so that the next process need not compare."""

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import write_text

log = logging.getLogger(__name__)

VARIABLE = "NERFDIFF_TRUSTED_KERNELS"
"""Environment variable that names the file. Empty: nothing is kept, and every process compares."""


def is_trusted(device: torch.device, use: str) -> bool:
    """Return true if kernels of these sources agreed in this use on such a device, with these libraries."""
    path = _file()
    return path is not None and use in _read(path).get(_made_by(device), ())


def trust(device: torch.device, uses: Sequence[str]) -> None:
    """Add uses that agreed. A file that cannot be written costs a comparison in the next process, and nothing else."""
    path = _file()
    if path is None:
        return
    known = _read(path)
    key = _made_by(device)
    known[key] = sorted({*known.get(key, ()), *uses})
    try:
        write_text(path, json.dumps(known, indent=1))
    except DataError as error:
        log.warning("the next process compares kernels with the reference again: %s", error)


def _file() -> Path | None:
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named) if named else None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerfdiff" / "trusted_kernels.json"


def _read(path: Path) -> dict[str, list[str]]:
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        if not all(isinstance(use, str) for uses in known.values() for use in uses):
            raise TypeError("expected lists of strings")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        log.warning("%s is ignored, and kernels are compared with the reference again: %s", path, error)
        return {}
    return known


def _made_by(device: torch.device) -> str:
    name = device.type
    if device.type == "cuda":
        name = f"{torch.cuda.get_device_name(device)}, {torch.cuda.get_device_capability(device)}"
    return f"{name}; torch {torch.__version__}; triton {_triton()}; sources {_sources()}"


@cache
def _triton() -> str:
    try:
        return version("triton")
    except PackageNotFoundError:  # a build under another name
        return "unknown"


@cache
def _sources() -> str:
    """Return a digest of all that renders, the reference included."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
