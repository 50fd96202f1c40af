"""Write rendered scenes in the SRN layout, with depth and mask beside the colours.

    <root>/cars_train|cars_val|cars_test/<id>/
        intrinsics.txt  scene.json
        rgb/000000.png    8-bit RGB on white
        pose/000000.txt   cam2world, OpenCV axes
        depth/000000.npz  array `depth`, float32: distance along z in scene units, 0 where nothing was hit
        mask/000000.png   8-bit: 255 where the ray through the pixel's centre hits, else 0
    <root>/chairs_train/chairs_2.0_train/<id>/…    nested in training, as the public archive has it
    <root>/scenes.json    what the folder was made with

A scene's folder appears under its name only when it is complete.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from nerfdiff.errors import ConfigError, DataError
from nerfdiff.scenes.mitsuba_renderer import Views
from nerfdiff.scenes.poses import intrinsics_text, pose_text

MANIFEST = "scenes.json"
SPLITS = ("train", "val", "test")


def split_folder(category: str, split: str) -> str:
    """Where SRN keeps a split, relative to the dataset's root."""
    if (category, split) == ("chairs", "train"):
        return "chairs_train/chairs_2.0_train"
    return f"{category}_{split}"


def scene_folder(root: Path, category: str, split: str, index: int) -> Path:
    """The folder of scene `index` of a split."""
    return Path(root) / split_folder(category, split) / f"{index:06d}"


def write_scene(
    root: Path, folder: Path, views: Views, c2w: Float[np.ndarray, "views 4 4"], facts: dict[str, Any]
) -> None:
    """Write one scene completely, then move it to `folder`; `facts` go into its `scene.json`.

    Half-written scenes stay under `<root>/.partial`, where no reader looks.

    Raises:
        DataError: the scene cannot be written (disk full, no permission).
    """
    partial = Path(root) / ".partial" / f"{folder.parent.name}-{folder.name}-{os.getpid()}"
    try:
        shutil.rmtree(partial, ignore_errors=True)
        for kind in ("rgb", "pose", "depth", "mask"):
            (partial / kind).mkdir(parents=True)
        for k, pose in enumerate(c2w):
            Image.fromarray(views.rgb[k]).save(partial / "rgb" / f"{k:06d}.png")
            (partial / "pose" / f"{k:06d}.txt").write_text(pose_text(pose))
            np.savez_compressed(partial / "depth" / f"{k:06d}.npz", depth=views.depth[k].astype(np.float32))
            mask = views.mask[k].astype(np.uint8) * 255
            Image.fromarray(mask).save(partial / "mask" / f"{k:06d}.png")
        (partial / "intrinsics.txt").write_text(intrinsics_text(views.rgb.shape[1]))
        (partial / "scene.json").write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n")
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial.rename(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise DataError(f"cannot write scene {folder}: {error}; free the disk or choose another root") from error


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
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_text(json.dumps(wanted, indent=1, sort_keys=True) + "\n")
        os.replace(temporary, path)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error}; choose another root") from error
