"""The folder a data set is made in: one run at a time, one set of parameters, only complete scenes."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.files import write_text

MANIFEST = "scenes.json"


@contextmanager
def half_written(root: Path, scene: Path) -> Iterator[Path]:
    """A folder to write `scene` into, where no reader looks; the caller moves its contents when complete.

    Raises:
        DataError: the scene cannot be written (disk full, no permission).
    """
    partial = Path(root) / ".partial" / f"{scene.parent.name}-{scene.name}-{os.getpid()}"
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
    except OSError as error:
        raise DataError(f"cannot write scene {scene}: {error}; free the disk or choose another root") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def exclusive(root: Path) -> Iterator[None]:
    """Keep other runs out of `root` meanwhile, and leave no half-written scene of a killed run behind.

    Raises:
        DataError: another run is at work in `root`, or the folder cannot be made.
    """
    lock = Path(root) / ".lock"
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        handle = lock.open("w")
    except OSError as error:
        raise DataError(f"cannot write into {root}: {error}; choose another root") from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(f"another run is making scenes in {root}; wait for it or choose another root") from error
        shutil.rmtree(Path(root) / ".partial", ignore_errors=True)
        try:
            yield
        finally:
            shutil.rmtree(Path(root) / ".partial", ignore_errors=True)


def check_manifest(root: Path, parameters: dict[str, Any]) -> None:
    """Record what `root` is made with, or check that an earlier run made it with the same.

    A split that is new, and a larger or smaller number of scenes, are no conflict: every scene depends on
    its own index alone.

    Raises:
        ConfigError: `root` holds scenes made with other parameters.
        DataError: `root` cannot be written, its manifest cannot be read, or it holds other things.
    """
    path = Path(root) / MANIFEST
    wanted = json.loads(json.dumps(parameters))
    if path.exists():
        try:
            found = json.loads(path.read_text())
            views = found.get("views", {})
        except (OSError, ValueError, AttributeError) as error:
            raise DataError(
                f"{path}: not a readable manifest ({error}); delete the folder or choose another root"
            ) from error
        known = {**wanted["views"], **views}
        differing = [
            f"{key}: {found.get(key)!r} there, {wanted[key]!r} asked for"
            for key in wanted
            if key != "views" and found.get(key) != wanted[key]
        ]
        differing += [
            f"splits.{split}.views: {known[split]} there, {count} asked for"
            for split, count in wanted["views"].items()
            if known[split] != count
        ]
        if differing:
            raise ConfigError(
                f"{path.parent} holds scenes made with other parameters ({'; '.join(differing)}); "
                "choose another root, or delete that folder"
            )
        wanted["views"] = known
        if wanted == found:
            return
    write_text(path, json.dumps(wanted, indent=1, sort_keys=True) + "\n")
