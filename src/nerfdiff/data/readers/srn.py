"""SRN-ShapeNet cars and chairs, and every dataset written in their layout.

    <root>/cars_train/<id>/{intrinsics.txt, rgb/000000.png …, pose/000000.txt …}
    <root>/chairs_train/chairs_2.0_train/<id>/…

Poses are camera-to-world with OpenCV axes in a z-up world, so nothing needs converting.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nerfdiff.cameras import Cameras
from nerfdiff.data.formats import images
from nerfdiff.data.formats.npz_files import read_depth
from nerfdiff.data.formats.posed_files import inverse_pose, read_pose
from nerfdiff.data.readers.framing import Framing, stack_pixels
from nerfdiff.data.readers.index import fingerprint_folders
from nerfdiff.data.readers.masks import read_mask
from nerfdiff.data.readers.srn_intrinsics import SceneIntrinsics, read_view_intrinsics
from nerfdiff.data.scene import Listing, MissingSplit, Scene
from nerfdiff.utils.errors import ConfigError, DataError, some

SPLITS = ("train", "val", "test")
PARENTS = ("", "srn_{category}", "srn_{category}/srn_{category}")
FOLDERS = {"cars": ("cars_{split}",), "chairs": ("chairs_{split}/chairs_2.0_{split}", "chairs_{split}")}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class _Folder:
    """The files of one scene, listed but not read."""

    path: Path
    views: tuple[str, ...]
    rgb: tuple[Path, ...]


class SRNReader:
    """One split of an SRN-layout dataset.

    Args:
        root: the folder that holds `cars_train`, or that holds it within `srn_cars/` or `srn_cars/srn_cars/`.
        category: "cars" or "chairs".
        split: "train", "val" or "test".
        near, far: bounds of every scene as distances along rays.
        image_size: (height, width), or one side of a square, to resize to; None keeps the stored size.
        crop: (height, width), or one side of a square, to cut out of the middle before; None keeps all.

    Raises:
        ConfigError: an unknown category or split, or bounds that are not 0 < near < far.
        MissingSplit: `root` has no such split, or no scenes in it; the message lists what was looked for.
        DataError: `root` is missing or empty.
    """

    nearest_view = False

    def __init__(
        self,
        root: str | Path,
        category: str,
        split: str,
        near: float,
        far: float,
        image_size: int | Sequence[int] | None = None,
        crop: int | Sequence[int] | None = None,
    ):
        if category not in FOLDERS:
            raise ConfigError(f"SRN category {category!r} is unknown; choose one of {', '.join(FOLDERS)}")
        if split not in SPLITS:
            raise ConfigError(f"split {split!r} is unknown; choose one of {', '.join(SPLITS)}")
        if not 0 < near < far:
            raise ConfigError(f"near = {near} and far = {far} must satisfy 0 < near < far")
        self.near, self.far = float(near), float(far)
        self.framing = Framing.of(crop, image_size)
        self.folder = _find_split(Path(root), category, split)
        self.scenes = tuple(
            sorted(e.name for e in os.scandir(self.folder) if e.is_dir() and not e.name.startswith("."))
        )
        if not self.scenes:
            raise MissingSplit(f"{self.folder}: the {split} split is empty; expected one folder per scene in it")
        self.identity = f"srn {self.folder.resolve()} {self.framing} bounds {self.near} {self.far}"
        self._listed: dict[int, _Folder] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def fingerprint(self) -> str:
        """Digest names, sizes and times of change of all images, poses and intrinsics."""
        parts = ("", "rgb", "pose", "intrinsics")
        return fingerprint_folders(self.folder / scene / part for scene in self.scenes for part in parts)

    def scene_id(self, index: int) -> str:
        return self.scenes[index]

    def view_names(self, index: int) -> tuple[str, ...]:
        return self._list(index).views

    def listing(self, index: int) -> Listing:
        folder = self._list(index)
        kinds = [("pose", "txt"), ("intrinsics", "txt"), ("mask", "png"), ("depth", "npz")]
        there = [(kind, suffix) for kind, suffix in kinds if (folder.path / kind).is_dir()]
        files = {
            name: [image, *(folder.path / kind / f"{name}.{suffix}" for kind, suffix in there)]
            for name, image in zip(folder.views, folder.rgb, strict=True)
        }
        return Listing(np.stack(_poses(folder, folder.views, _shared_intrinsics(folder.path))), files)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        folder = self._list(index)
        positions = range(len(folder.views)) if views is None else views
        names = tuple(folder.views[p] for p in positions)
        shared = _shared_intrinsics(folder.path)
        stated = None if shared is None else (shared.height, shared.width)
        stored = [images.decode(folder.rgb[p], stated) for p in positions]
        sizes = [image.shape[:2] for image in stored]
        K = self._intrinsics(folder, names, sizes, shared)
        pixels = stack_pixels([self.framing.image(image) for image in stored], [folder.rgb[p] for p in positions])
        poses = _poses(folder, names, shared)
        return Scene(
            id=self.scenes[index],
            views=names,
            pixels=pixels,
            cameras=Cameras(torch.from_numpy(np.stack(poses)).float(), torch.from_numpy(K).float(), *pixels.shape[-2:]),
            near=self.near,
            far=self.far,
            mask=self._truth(folder, names, sizes, "mask") if truth else None,
            depth=self._truth(folder, names, sizes, "depth") if truth else None,
        )

    def _list(self, index: int) -> _Folder:
        if index not in self._listed:
            path = self.folder / self.scenes[index]
            rgb = _files_by_stem(path / "rgb", IMAGE_SUFFIXES)
            pose = _files_by_stem(path / "pose", (".txt",))
            if rgb.keys() != pose.keys():
                raise DataError(
                    f"{path}: {len(rgb)} images in rgb/ and {len(pose)} poses in pose/ do not match by name; "
                    f"images without a pose: {some(rgb.keys() - pose.keys())}; "
                    f"poses without an image: {some(pose.keys() - rgb.keys())}"
                )
            self._listed[index] = _Folder(path, tuple(sorted(rgb)), tuple(rgb[name] for name in sorted(rgb)))
        return self._listed[index]

    def _intrinsics(
        self,
        folder: _Folder,
        names: Sequence[str],
        sizes: Sequence[tuple[int, int]],
        shared: SceneIntrinsics | None,
    ) -> Float[np.ndarray, "views 3 3"]:
        """K of each view, at the size at which it will be returned."""
        if shared is not None:
            K = [shared.K(*size) for size in sizes]
        else:
            files = [folder.path / "intrinsics" / f"{name}.txt" for name in names]
            K = [read_view_intrinsics(f, *size) for f, size in zip(files, sizes, strict=True)]
        return np.stack([self.framing.K(k, *size) for k, size in zip(K, sizes, strict=True)])

    def _truth(self, folder: _Folder, names: Sequence[str], sizes: Sequence[tuple[int, int]], kind: str):
        """`mask/<view>.png` or `depth/<view>.npz` of generated scenes; None where the folder is not there."""
        if not (folder.path / kind).is_dir():
            return None
        read, suffix = (read_mask, "png") if kind == "mask" else (read_depth, "npz")
        values = []
        for name, size in zip(names, sizes, strict=True):
            file = folder.path / kind / f"{name}.{suffix}"
            value = read(file)
            if value.shape != size:
                raise DataError(f"{file}: shape {value.shape[0]}x{value.shape[1]}, its image has {size[0]}x{size[1]}")
            values.append(self.framing.values(value))
        return torch.from_numpy(np.stack(values))


def _poses(folder: _Folder, names: Sequence[str], shared: SceneIntrinsics | None) -> list[Float[np.ndarray, "4 4"]]:
    poses = [read_pose(folder.path / "pose" / f"{name}.txt") for name in names]
    return [inverse_pose(pose) for pose in poses] if shared is not None and shared.world2cam else poses


def _shared_intrinsics(scene: Path) -> SceneIntrinsics | None:
    """`intrinsics.txt`; None for the flavour that has a file per view instead."""
    file = scene / "intrinsics.txt"
    if not file.exists() and (scene / "intrinsics").is_dir():
        return None
    return SceneIntrinsics.read(file)


def _find_split(root: Path, category: str, split: str) -> Path:
    wanted = [
        Path(parent.format(category=category)) / folder.format(split=split)
        for parent in PARENTS
        for folder in FOLDERS[category]
    ]
    looked_for = ", ".join(str(w) for w in wanted)
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; set data.root to the folder that holds one of {looked_for}")
    for folder in wanted:
        if (root / folder).is_dir():
            return root / folder
    found = sorted(entry.name for entry in root.iterdir())
    if not found:
        raise DataError(f"{root}: the folder is empty; expected one of {looked_for} in it")
    raise MissingSplit(f"{root}: no {split} split of SRN {category}; looked for {looked_for}; found only {some(found)}")


def _files_by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files with one of these suffixes; a stray or half-copied file shows as a view that has no partner."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; every scene of an SRN layout has rgb/ and pose/")
    files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    if not files:
        raise DataError(f"{folder}: no {' or '.join(suffixes)} files in it")
    by_stem = {file.stem: file for file in files}
    if len(by_stem) < len(files):
        raise DataError(f"{folder}: {len(files) - len(by_stem)} views are there twice, under several suffixes")
    return by_stem
