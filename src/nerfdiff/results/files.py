"""Files that are either whole or absent."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerfdiff.errors import DataError


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary path in the folder of `path` (created if missing), moved onto `path` if the block succeeds.

    The temporary name keeps the suffix, by which writers of pictures and videos choose their format.

    Raises:
        DataError: the file cannot be written (disk full, no permission); nothing is left behind.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        mode = temporary.stat().st_mode  # the umask's; some writers, as safetensors, write for the owner alone
        temporary.unlink()
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, path)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write `text` atomically, see `atomic`."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
