"""Results of scanning a large dataset, kept in a small file, so that the next start does not scan again."""

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import write_text

log = logging.getLogger(__name__)

T = TypeVar("T")


def cached_index(
    folder: str | Path, name: str, stamp: str, build: Callable[[], T], fresh: Callable[[T], bool] | None = None
) -> T:
    """Return `build`'s value, from `<folder>/<name>.index.json` where that file has the same stamp.

    A file that is missing, damaged or outdated is written anew. Where it cannot be written, a warning says so
    and the next start builds again.

    Args:
        folder: where indexes are kept.
        name: of the index; has to tell apart the datasets that share `folder`, see `index_name`.
        stamp: of what the index was built from, see `folder_stamp`; another stamp rebuilds it.
        build: makes the index, of JSON values only; tuples come back as lists.
        fresh: also decides whether a stored index still holds, where that takes knowing what is in it.

    Raises:
        DataError: whatever `build` raises; nothing is stored then.
    """
    file = Path(folder) / f"{name}.index.json"
    try:
        stored = json.loads(file.read_bytes())
        if stored["stamp"] == stamp and (fresh is None or fresh(stored["index"])):
            return stored["index"]
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        log.warning("%s is damaged (%s); scanning anew", file, error)
    text = json.dumps({"stamp": stamp, "index": build()})
    try:
        write_text(file, text)
    except DataError as error:
        log.warning("%s: every start scans the dataset; set data.cache_dir to a folder that can be written", error)
    return json.loads(text)["index"]


def index_name(kind: str, root: str | Path) -> str:
    """A name for the index of the dataset at `root`, so that several may share one folder."""
    return f"{kind}-{hashlib.sha256(str(Path(root).resolve()).encode()).hexdigest()[:12]}"


def folder_stamp(paths: Iterable[Path]) -> str:
    """Digest of names and times of change of these files and folders, in order; what is missing counts as such.

    A folder's time changes when something directly in it is added, removed or renamed, also when a file is
    replaced by renaming another over it; not when a file is overwritten in place.
    """
    digest = hashlib.sha256()
    for path in paths:
        try:
            time = os.stat(path).st_mtime_ns
        except OSError:
            time = None
        digest.update(f"\n{path.name}\0{time}".encode())
    return digest.hexdigest()


def fingerprint_folders(folders: Iterable[Path]) -> str:
    """Digest of the files directly inside `folders`, in order (about a second for 250,000 local files).

    A folder that is not there counts as such. Files whose names begin with a dot are left out.
    """
    digest = hashlib.sha256()
    for folder in folders:
        digest.update(f"\n{folder.name}".encode())
        try:
            with os.scandir(folder) as entries:
                files = sorted((e.name, e.stat()) for e in entries if e.name[0] != "." and os.path.isfile(e))
        except FileNotFoundError:
            continue
        except OSError as error:
            raise DataError(f"{folder}: the folder cannot be listed ({error.strerror})") from error
        for name, stat in files:
            digest.update(f"\0{name}\0{stat.st_size}\0{stat.st_mtime_ns}".encode())
    return digest.hexdigest()
