"""Search for the objects' folders in a large download, done once and kept."""

import os
import re
from pathlib import Path

from nerfdiff.data.readers.index import cached_index, index_name
from nerfdiff.utils.errors import DataError, some

DEPTH = 5
"""Levels below the root at which objects are looked for; archives keep their author's folders, up to four of them."""


def item_folders(
    root: Path, index_dir: str | Path, kind: str, key_file: str, images: str | None = None
) -> dict[str, Path]:
    """Folders below `root` that hold `key_file`, by name, in order of their names.

    A folder that has `images` counts although `key_file` is missing, so that an incomplete object is an error
    when it is read and does not vanish. When a run starts, only folders that are not those
    of objects are looked at again: that is how objects that are added, removed or renamed are noticed.

    Args:
        index_dir: where the index is kept.
        kind: of dataset, for the index's name.
        images: regular expression of the names of an object's images, with {item} for the name of its folder.

    Raises:
        DataError: `root` is missing, or has no such folder, or two of one name.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; set data.root to the folder that holds <item>/{key_file}")

    def build() -> dict:
        index = {"searched": {}, "items": []}
        _search(root, "", key_file, images, index)
        return index

    def fresh(index: dict) -> bool:
        """A file beside the objects changes the time of their folder, too: then its subfolders are compared."""
        return all(
            _time(root / folder) == time or _subfolders(root, folder, key_file, images) == subfolders
            for folder, (time, subfolders) in index["searched"].items()
        )

    stamp = f"2 {kind} {root.resolve()}"
    index = cached_index(index_dir, index_name(kind, root), stamp, build, fresh)
    items = {Path(item).name: root / item for item in sorted(index["items"], key=lambda item: Path(item).name)}
    if not items:
        found = sorted(entry.name for entry in root.iterdir())
        raise DataError(
            f"{root}: {f'found only {some(found)}' if found else 'the folder is empty'}; looked for "
            f"<item>/{key_file} in it and up to {DEPTH} folders below; set data.root to the folder that holds them"
        )
    if len(items) < len(index["items"]):
        twice = {name for name in items if sum(Path(item).name == name for item in index["items"]) > 1}
        raise DataError(f"{root}: objects that are there twice, in several folders: {some(twice)}; keep one of each")
    return items


def _search(root: Path, folder: str, key_file: str, images: str | None, index: dict, depth: int = DEPTH) -> None:
    time = _time(root / folder)  # before it is listed: what changes meanwhile makes the index outdated, not wrong
    subfolders = _subfolders(root, folder, key_file, images)
    if subfolders is None:
        index["items"].append(folder)
        return
    index["searched"][folder] = [time, subfolders]
    for name in subfolders if depth else ():
        _search(root, os.path.join(folder, name), key_file, images, index, depth - 1)


def _subfolders(root: Path, folder: str, key_file: str, images: str | None) -> list[str] | None:
    """Names of the folders in a folder, sorted; None where the folder is that of an object."""
    pattern = re.escape(key_file)
    if images is not None:
        pattern = f"{pattern}|{images.format(item=re.escape(Path(folder).name))}"
    try:
        with os.scandir(root / folder) as entries:
            entries = [entry for entry in entries if entry.name[0] != "."]
    except OSError as error:
        raise DataError(f"{root / folder}: the folder cannot be listed ({error.strerror})") from error
    if folder and any(re.fullmatch(pattern, entry.name) for entry in entries):
        return None
    return sorted(entry.name for entry in entries if entry.is_dir())


def _time(folder: Path) -> int | None:
    try:
        return os.stat(folder).st_mtime_ns
    except OSError:
        return None
