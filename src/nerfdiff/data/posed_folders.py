"""Which folders are the scenes of a split, in a folder of posed images."""

import os
from collections.abc import Mapping
from pathlib import Path

from nerfdiff.data.scene import MissingSplit
from nerfdiff.data.split_file import draw_split
from nerfdiff.data.transforms_json import ONE_FILE, SPLIT_FILES, is_scene
from nerfdiff.errors import ConfigError, DataError


def find_scenes(root: Path, split: str, split_sizes: Mapping[str, int], seed: int) -> tuple[Path, ...]:
    """The scene folders of a split, sorted by name. Apart from listing `root`, no folder is looked into.

    A folder that is itself a scene is every split. Folders named as splits hold the scenes of these. Else every folder
    is a scene, a single one is every split, and several are shared out by `split_file.draw_split`.

    Raises:
        ConfigError: an unknown split.
        MissingSplit: the scenes lie in folders for other splits, or are too few; or the split's folder is empty.
        DataError: `root` is missing or has no scenes.
    """
    if split not in split_sizes:
        raise ConfigError(f"split {split!r} is unknown; choose one of {', '.join(split_sizes)}")
    wanted = f"{ONE_FILE} (or {', '.join(SPLIT_FILES)})"
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; set data.root to a folder of scenes, each with its {wanted}")
    if is_scene(root):
        return (root,)
    folders = _folders(root)
    laid_out = [folder.name for folder in folders if folder.name in split_sizes]
    if laid_out:
        if split not in laid_out:
            raise MissingSplit(f"{root}: no {split} split; found only {', '.join(laid_out)}")
        scenes = _folders(root / split)
        if not scenes:
            raise MissingSplit(
                f"{root / split}: the split is empty; expected one folder per scene, each with its {wanted}"
            )
        return scenes
    if not folders:
        raise DataError(f"{root}: no scenes; expected one folder per scene, each with its {wanted}")
    if len(folders) == 1:
        return folders
    names = draw_split([folder.name for folder in folders], split_sizes, seed)[split]
    if not names:
        raise MissingSplit(
            f"{root}: {len(folders)} scenes are too few for a {split} split of {split_sizes[split]} in "
            f"{sum(split_sizes.values())}; put them into folders {', '.join(split_sizes)}, or change "
            "data.reader.split_sizes"
        )
    return tuple(root / name for name in names)


def _folders(folder: Path) -> tuple[Path, ...]:
    with os.scandir(folder) as entries:
        return tuple(sorted(Path(e.path) for e in entries if e.is_dir() and not e.name.startswith(".")))
