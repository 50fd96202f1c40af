"""Files and folders that are either whole or absent, also after a power cut, and folders that one process holds."""

import errno
import math
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import filelock
import psutil

from nerfdiff.utils.errors import BusyError, DataError

NONFINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


@contextmanager
def atomic(path: Path, former: Path | None = None) -> Iterator[Path]:
    """A temporary path in the folder of `path` (created if missing), moved onto `path` if the block succeeds.

    What was written is on the disk before it takes its name. The temporary name keeps the suffix, by which writers of
    pictures and videos choose their format.

    Args:
        former: where the file that is replaced is kept.

    Raises:
        DataError: the file cannot be written (disk full, no permission); nothing is left behind.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        make_folder(path.parent)
        temporary.touch()
        mode = temporary.stat().st_mode  # the umask's; some writers, as safetensors, write for the owner alone
        temporary.unlink()
        yield temporary
        temporary.chmod(mode)
        _sync(temporary)
        if former is not None and path.exists():
            _keep(path, former)
        os.replace(temporary, path)
        _sync(path.parent)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write `text` atomically, see `atomic`."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def remove_leftovers(folder: Path, name: str = "*") -> None:
    """Remove what processes that were killed left half-written in a folder, which the caller holds.

    Args:
        name: of the files or folders that were to be written, without their suffix.
    """
    for left in Path(folder).glob(f".{name}.tmp*"):
        if re.fullmatch(r"\..+\.\d+\.tmp(\..*)?", left.name) and f".{os.getpid()}.tmp" not in left.name:
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                with suppress(OSError):
                    left.unlink()


def publish(partial: Path, final: Path) -> None:
    """Give a folder its name, once all that is in it is on the disk.

    Raises:
        OSError: it cannot be moved.
    """
    settle(partial)
    partial.rename(final)
    _sync(final.parent)


def settle(folder: Path) -> None:
    """Wait until all that is in a folder is on the disk."""
    for inner, _, names in os.walk(folder):
        for name in names:
            _sync(Path(inner) / name)
        _sync(Path(inner))


def make_folder(folder: Path) -> None:
    """Create a folder, and those that it is in, on the disk too."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


@contextmanager
def held(folder: Path, patience: float = 15.0) -> Iterator[None]:
    """Hold a folder against other processes that want to hold it; a process that is killed lets go of it.

    Args:
        patience: seconds to wait where the holder was killed, for the workers that it leaves behind to notice.

    Raises:
        BusyError: another process holds it; the message says which.
        DataError: the folder cannot be written.
    """
    folder = Path(folder)
    lock, owner = filelock.FileLock(folder / ".lock"), folder / ".owner"
    try:
        make_folder(folder)
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            lock.acquire(timeout=patience if _was_killed(owner) else 0)
    except filelock.Timeout as error:
        with suppress(OSError):
            raise BusyError(
                f"{owner.read_text(encoding='utf-8')} is working in {folder}: wait until it has ended, stop it, or "
                "choose another run_name"
            ) from error
        raise BusyError(f"another process is working in {folder}: wait until it has ended") from error
    except (OSError, NotImplementedError) as error:  # the latter is filelock's, where a disk has no locks
        raise DataError(f"{folder} cannot be locked for this run ({error}); choose another paths.runs_dir") from error
    try:
        owner.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        owner.unlink(missing_ok=True)
        lock.release()


def _was_killed(owner: Path) -> bool:
    """Return true if the process that says it holds a folder is one of this machine that is no more."""
    try:
        _, pid, _, host = owner.read_text(encoding="utf-8").split(maxsplit=3)
    except (OSError, ValueError):
        return False
    return host == socket.gethostname() and not psutil.pid_exists(int(pid))


def _keep(path: Path, former: Path) -> None:
    """A second name for a file that is about to be replaced; where disks have no links, its only one for a moment."""
    link = former.with_name(f".{former.stem}.{os.getpid()}.tmp{former.suffix}")
    try:
        os.link(path, link)
    except OSError:
        link = path
    os.replace(link, former)


def _sync(path: Path) -> None:
    """Wait until a file, or a folder's list of names, is on the disk."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network disks sync no folders
            raise
    finally:
        os.close(file)


def encode(value: Any) -> Any:
    """`value` with non-finite floats as strings, so that it is valid JSON."""
    if isinstance(value, Mapping):
        return {key: encode(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [encode(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value
