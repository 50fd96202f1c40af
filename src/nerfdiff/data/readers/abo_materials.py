"""Amazon Berkeley Objects, 91-view material set (`abo-benchmark-material.tar`).

    <root>/train_test_split.csv
    <root>/…/<item_id>/metadata.json                      poses and K
    <root>/…/<item_id>/render/<environment>/render_0.jpg  in up to three environments of light
    <root>/…/<item_id>/segmentation/segmentation_0.jpg    what is laid on white
    <root>/…/<item_id>/depth/depth_0.exr                  at least 65000 where nothing is

Cameras are centred and scaled as those of the 30-view renders.
"""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.formats import images
from nerfdiff.data.formats.exr import read_exr
from nerfdiff.data.formats.posed_files import check_K
from nerfdiff.data.readers.abo_material_files import (
    KEY_FILE,
    MaterialViews,
    find_split_file,
    numbered_files,
    read_split,
)
from nerfdiff.data.readers.framing import Framing, stack_pixels
from nerfdiff.data.readers.index import cached_index, folder_stamp, index_name
from nerfdiff.data.readers.item_folders import item_folders
from nerfdiff.data.readers.masks import read_mask
from nerfdiff.data.readers.optical_axes import ObjectCameras, check_settings, object_cameras, report
from nerfdiff.data.readers.split_file import seeded_order
from nerfdiff.data.scene import Listing, MissingSplit, Scene
from nerfdiff.utils.errors import ConfigError, DataError, some

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
NOTHING = 65000.0
"""Stored depth from which on nothing was hit: half floats end at 65504."""
log = logging.getLogger(__name__)


class ABOMaterials:
    """One split of the 91-view material set, or of any dataset in its layout.

    The release splits into train and test. Where it has no val, one is taken from train by `split_seed`.

    Args:
        root: the folder that holds `train_test_split.csv`, or has a folder that does.
        split: "train", "val" or "test".
        near, far: bounds of every scene as distances along rays, in units in which cameras are `distance` away.
        distance: mean distance of an object's cameras from its centre, to which each scene is scaled.
        convention: axes of the poses: "auto" (told from where cameras look), "opengl" (the release's) or "opencv".
        environment: "first" of an object's environments of light, the name of one, or "all", where each
            environment of an object is a scene.
        depth_kind: "z" where stored depth is along the camera's axis, "ray" where it is along each pixel's ray.
        missing_items: "error" or "skip" objects of the table that have no folder.
        val_fraction: share of the training objects that is held out for val.
        split_seed: by which those are drawn.
        index_dir: where the list of objects is kept, so that only the first start looks for them.
        image_size: (height, width), or one side of a square, to resize to; None keeps the stored size.
        crop: (height, width), or one side of a square, to cut out of the middle before; None keeps all.

    Raises:
        ConfigError: a setting is none of the above.
        MissingSplit: the split has no objects.
        DataError: `root` is missing or has no objects in it, or they are not those of its table.
    """

    nearest_view = False

    def __init__(
        self,
        root: str | Path,
        split: str,
        near: float,
        far: float,
        distance: float,
        convention: str,
        environment: str | int,
        depth_kind: str,
        missing_items: str,
        val_fraction: float,
        split_seed: int,
        index_dir: str | Path,
        image_size: int | Sequence[int] | None = None,
        crop: int | Sequence[int] | None = None,
    ):
        choices = {
            "split": (split, ("train", "val", "test")),
            "depth_kind": (depth_kind, ("z", "ray")),
            "missing_items": (missing_items, ("error", "skip")),
        }
        for key, (value, allowed) in choices.items():
            if value not in allowed:
                raise ConfigError(f"{key} {value!r} is unknown; choose one of {', '.join(allowed)}")
        if not 0 <= val_fraction < 1:
            raise ConfigError(f"val_fraction = {val_fraction} must be at least 0 and below 1")
        check_settings(near, far, distance, convention)
        self.near, self.far, self.distance = float(near), float(far), float(distance)
        self.convention, self.depth_kind = convention, depth_kind
        self.framing = Framing.of(crop, image_size)
        self.root = Path(root)
        table = find_split_file(self.root)
        splits = _with_val(read_split(table), val_fraction, split_seed)
        if not splits[split]:
            sizes = ", ".join(f"{len(members)} {name}" for name, members in splits.items())
            raise MissingSplit(f"{self.root}: no {split} split; {table.name} has {sizes}")
        folders = item_folders(self.root, index_dir, "abo_materials", KEY_FILE)
        items = _present(splits[split], folders, table, skip=missing_items == "skip")
        named = f"{self.root.resolve()} {split} {environment} {missing_items} {val_fraction} {split_seed}"
        environments = self._environments(items, folders, str(environment), index_dir, named)
        self.scenes = tuple(f"{item}_{e}" if environment == "all" else item for item, e in environments)
        self.folders = tuple(folders[item] for item, _ in environments)
        self.environments = tuple(e for _, e in environments)
        self.identity = (
            f"abo_materials {named} {self.framing} {convention} {depth_kind} {self.distance} {self.near} {self.far}"
        )
        self._numbers: dict[int, tuple[int, ...]] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def fingerprint(self) -> str:
        """Digest the times of change of folders and `metadata.json`; images overwritten in place are not noticed."""
        parts = ("", KEY_FILE, "segmentation", "render")
        return folder_stamp(
            folder / part
            for folder, environment in zip(self.folders, self.environments, strict=True)
            for part in (*parts, *([] if environment is None else [f"render/{environment}"]))
        )

    def scene_id(self, index: int) -> str:
        return self.scenes[index]

    def view_names(self, index: int) -> tuple[str, ...]:
        """`render_<number>`, in the order of the numbers."""
        if index not in self._numbers:
            self._numbers[index] = MaterialViews.read(self.folders[index]).numbers
        return tuple(f"render_{number}" for number in self._numbers[index])

    def geometry(self, index: int) -> ObjectCameras:
        """All cameras of a scene as the file has them: what convention was found, and what they look at."""
        return self._geometry(index, MaterialViews.read(self.folders[index]))

    def listing(self, index: int) -> Listing:
        folder, stored = self.folders[index], MaterialViews.read(self.folders[index])
        kinds = self._files(index, folder, stored.numbers, truth=True).values()
        files = dict(zip(self.view_names(index), zip(*kinds, strict=True), strict=True))
        return Listing(self._geometry(index, stored).normalised(self.distance).c2w, files)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        folder, stored = self.folders[index], MaterialViews.read(self.folders[index])
        geometry = self._geometry(index, stored)
        report(self.root, geometry)
        found = self._files(index, folder, stored.numbers, truth)
        renders, segments = found["render"], found["segmentation"]
        positions = list(range(len(stored.numbers)) if views is None else views)
        masks = [read_mask(segments[p]) for p in positions]
        on_white = [_on_white(renders[p], mask, segments[p]) for p, mask in zip(positions, masks, strict=True)]
        K = [_checked_K(folder, stored, p, mask.shape) for p, mask in zip(positions, masks, strict=True)]
        depth = None
        if "depth" in found:
            files = found["depth"]
            scale = self.distance / geometry.distance
            depth = [
                self.framing.values(scale * self._z_depth(files[p], k, mask.shape))
                for p, k, mask in zip(positions, K, masks, strict=True)
            ]
        pixels = stack_pixels([self.framing.image(image) for image in on_white], [renders[p] for p in positions])
        K = np.stack([self.framing.K(k, *mask.shape) for k, mask in zip(K, masks, strict=True)])
        c2w = geometry.normalised(self.distance).c2w[positions]
        return Scene(
            id=self.scenes[index],
            views=tuple(self.view_names(index)[p] for p in positions),
            pixels=pixels,
            cameras=Cameras(torch.from_numpy(c2w).float(), torch.from_numpy(K).float(), *pixels.shape[-2:]),
            near=self.near,
            far=self.far,
            mask=_stacked([self.framing.values(mask) for mask in masks]) if truth else None,
            depth=None if depth is None else _stacked(depth),
        )

    def _files(self, index: int, folder: Path, numbers: tuple[int, ...], truth: bool) -> dict[str, list[Path]]:
        """Renders, segmentations and, for `truth` where there are any, depths of all views."""
        environment = self.environments[index]
        if environment is None:
            environment = _environments_of(folder)[0]
        wanted = {"render": (f"render/{environment}", IMAGE_SUFFIXES), "segmentation": ("segmentation", IMAGE_SUFFIXES)}
        if truth and (folder / "depth").is_dir():
            wanted["depth"] = ("depth", (".exr",))
        return {kind: numbered_files(folder / part, suffixes, numbers) for kind, (part, suffixes) in wanted.items()}

    def _geometry(self, index: int, stored: MaterialViews) -> ObjectCameras:
        names = tuple(map(str, stored.numbers))
        return object_cameras(stored.poses, self.convention, self.folders[index] / KEY_FILE, names)

    def _environments(
        self, items: Sequence[str], folders: dict[str, Path], environment: str, index_dir: str | Path, named: str
    ) -> list[tuple[str, str | None]]:
        """(object, environment) of every scene; the first environment is looked up when a scene is read."""
        if environment != "all":
            return [(item, None if environment == "first" else environment) for item in items]
        # Objects have up to three; a render folder's time changes when it gets another
        stamp = f"{named} {folder_stamp(folders[item] / 'render' for item in items)}"
        name = index_name("abo_environments", f"{self.root.resolve()}/{named}")
        found = cached_index(index_dir, name, stamp, lambda: [_environments_of(folders[item]) for item in items])
        return [(item, e) for item, names in zip(items, found, strict=True) for e in names]

    def _z_depth(
        self, file: Path, K: Float[np.ndarray, "3 3"], size: tuple[int, int]
    ) -> Float[np.ndarray, "height width"]:
        """Depth along the camera's axis in units of the file, 0 where nothing is."""
        depth = read_exr(file, size)
        depth = np.where(depth >= NOTHING, 0, depth)
        if not (np.isfinite(depth).all() and depth.min() >= 0):
            raise DataError(f"{file}: expected depths of at least 0, found NaN or negative ones")
        if self.depth_kind == "ray":
            v, u = np.indices(size) + 0.5
            x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
            depth = depth / np.sqrt(x**2 + y**2 + 1)
        return depth.astype(np.float32)


def _with_val(splits: dict[str, list[str]], fraction: float, seed: int) -> dict[str, list[str]]:
    if splits["val"] or not fraction or len(splits["train"]) < 2:
        return splits
    held_out = set(seeded_order(splits["train"], seed)[: max(1, round(fraction * len(splits["train"])))])
    train = [item for item in splits["train"] if item not in held_out]
    return splits | {"train": train, "val": sorted(held_out)}


def _present(items: list[str], folders: dict[str, Path], table: Path, skip: bool) -> list[str]:
    missing = set(items) - folders.keys()
    if missing and not skip:
        raise DataError(
            f"{table}: {len(missing)} of its objects have no folder with {KEY_FILE}: {some(missing)}; complete the "
            "download, or set data.reader.missing_items=skip to go on without them"
        )
    if len(missing) == len(items):
        raise DataError(f"{table}: none of its {len(items)} objects has a folder with {KEY_FILE}: {some(missing)}")
    if missing:
        log.warning("%s: going on without %d objects that have no folder: %s", table, len(missing), some(missing))
    return [item for item in items if item not in missing]


def _environments_of(folder: Path) -> list[str]:
    """Names of an object's environments, numbers in their order."""
    path = folder / "render"
    names = [p.name for p in path.iterdir() if p.is_dir() and p.name[0] != "."] if path.is_dir() else []
    if not names:
        raise DataError(f"{path}: no environment in it; expected folders like {path / '0'} with render_<number>.jpg")
    return sorted(names, key=lambda name: (int(re.sub(r"\D", "", name) or -1), name))


def _on_white(
    render: Path, mask: Bool[np.ndarray, "height width"], segmentation: Path
) -> UInt8[np.ndarray, "height width 3"]:
    image = images.decode(render)
    if image.shape[:2] != mask.shape:
        raise DataError(
            f"{segmentation}: {mask.shape[0]}x{mask.shape[1]} pixels, but {render} has "
            f"{image.shape[0]}x{image.shape[1]}"
        )
    return np.where(mask[..., None], image, np.uint8(255))


def _checked_K(folder: Path, stored: MaterialViews, position: int, size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    check_K(stored.K[position], *size, f"{folder / KEY_FILE}: view {stored.numbers[position]}")
    return stored.K[position]


def _stacked(values: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(values))
