"""Amazon Berkeley Objects, 30-view renders (`abo-release-renders.zip`, the set of the paper).

    <root>/…/<item_id>/{transforms.json, <item_id>_00.png … <item_id>_29.png}
    <root>/…/<item_id>/depth/<item_id>_00.npz …           in generated copies: array `depth` along the camera's axis

Images are RGBA with 8 or 16 bits. Poses are Blender's, around the object's centre at 1.8 / tan(20°) = 4.9455 times its
largest half-extent: the reader moves that centre to the origin and scales the distance to 4.9455 for every object.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.formats import images
from nerfdiff.data.formats.blender_camera import BlenderCamera
from nerfdiff.data.formats.json_files import entry, matrix, read_list
from nerfdiff.data.formats.npz_files import read_depth
from nerfdiff.data.readers.framing import Framing, stack_pixels
from nerfdiff.data.readers.index import folder_stamp
from nerfdiff.data.readers.item_folders import item_folders
from nerfdiff.data.readers.masks import stacked_masks
from nerfdiff.data.readers.optical_axes import ObjectCameras, check_settings, object_cameras, report
from nerfdiff.data.readers.split_file import stored_split
from nerfdiff.data.scene import Listing, MissingSplit, Scene
from nerfdiff.utils.errors import ConfigError, DataError, some

KEY_FILE = "transforms.json"
IMAGES = r"{item}_\d+\.png"


@dataclass(frozen=True)
class ItemTransforms:
    """The views of a `transforms.json`, in the order of the numbers at the ends of their names."""

    views: tuple[str, ...]
    poses: Float[np.ndarray, "views 4 4"]
    cameras: tuple[BlenderCamera, ...]

    @staticmethod
    def read(folder: Path) -> "ItemTransforms":
        """Parse `<folder>/transforms.json`, and compare it with the images beside it.

        A frame's `file_path` is a path of its author's, without suffix: only its last part counts.

        Raises:
            DataError: the file is missing, damaged or incomplete, or its frames are not the images in the folder; the
                message names the file and the frame.
        """
        file = folder / KEY_FILE
        frames = read_list(file, "frames", "one frame per image")
        parsed = {}
        for k, frame in enumerate(frames):
            where = f"{file}: frames[{k}]"
            name = re.split(r"[/\\]", entry(frame, "file_path", str, where))[-1].removesuffix(".png")
            if not name or name in parsed:
                raise DataError(
                    f"{where}: file_path {frame['file_path']!r} names no image of its own; expected one per frame"
                )
            pose = matrix(entry(frame, "transform_matrix", list, where), 4, 4, f"{where}: transform_matrix")
            camera = BlenderCamera.of(entry(frame, "camera", dict, where), f"{where}: camera")
            parsed[name] = pose, camera
        _require_images(folder, set(parsed))
        views = tuple(sorted(parsed, key=_number))
        return ItemTransforms(views, np.stack([parsed[v][0] for v in views]), tuple(parsed[v][1] for v in views))


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits[0]) if digits else -1, name)


def _require_images(folder: Path, frames: set[str]) -> None:
    """Other images than `<item>_<number>.png` (depth, normals) may lie beside those that frames name."""
    images = {file.removesuffix(".png") for file in os.listdir(folder) if file.endswith(".png")}
    views = {name for name in images if re.fullmatch(IMAGES.format(item=re.escape(folder.name)), f"{name}.png")}
    if frames - images or views - frames:
        raise DataError(
            f"{folder}: the frames of {KEY_FILE} and the images do not match by name; frames without an image: "
            f"{some(frames - images)}; images without a frame: {some(views - frames)}; expected <item>_<number>.png "
            "for each; copy what is missing"
        )


class ABORenders:
    """One split of the 30-view renders, or of any dataset in their layout.

    The release has no split. One is drawn from `split_seed` and stored, see `split_file.stored_split`: with the
    paper's 6743 + 396 + 794 objects it has exactly these sizes, with another number of objects (the release has 7953,
    a generated copy fewer) the same proportions of it. The paper's own assignment is unpublished.

    Args:
        root: a folder that has the folders of the objects in it, or up to five folders below.
        split: "train", "val" or "test".
        near, far: bounds of every scene as distances along rays, in units in which cameras are `distance` away.
        distance: mean distance of an object's cameras from its centre, to which each scene is scaled.
        convention: axes of the poses: "auto" (told from where cameras look), "opengl" (Blender's) or "opencv".
        split_seed: of the split.
        split_sizes: number of objects in each split of the whole release.
        index_dir: where the list of objects is kept, so that only the first start looks for them.
        image_size: (height, width), or one side of a square, to resize to; None keeps the stored size.
        crop: (height, width), or one side of a square, to cut out of the middle before; None keeps all.

    Raises:
        ConfigError: a setting is none of the above.
        MissingSplit: there are too few objects for this split.
        DataError: `root` is missing or has no objects in it, or a stored split does not fit them.
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
        split_seed: int,
        split_sizes: Mapping[str, int],
        index_dir: str | Path,
        image_size: int | Sequence[int] | None = None,
        crop: int | Sequence[int] | None = None,
    ):
        if split not in split_sizes:
            raise ConfigError(f"split {split!r} is unknown; choose one of {', '.join(split_sizes)}")
        check_settings(near, far, distance, convention)
        self.near, self.far, self.distance = float(near), float(far), float(distance)
        self.convention = convention
        self.framing = Framing.of(crop, image_size)
        self.root = Path(root)
        folders = item_folders(self.root, index_dir, "abo_renders", KEY_FILE, IMAGES)
        splits, self.split_sha256 = stored_split(self.root, index_dir, list(folders), split_sizes, split_seed)
        self.scenes = tuple(splits.get(split, ()))
        if not self.scenes:
            sizes = ", ".join(f"{len(members)} {name}" for name, members in splits.items())
            raise MissingSplit(f"{self.root}: no {split} split; {len(folders)} objects are split into {sizes}")
        self.folders = tuple(folders[scene] for scene in self.scenes)
        self.identity = (
            f"abo_renders {self.root.resolve()} {split} {self.split_sha256} {self.framing} {convention} "
            f"{self.distance} {self.near} {self.far}"
        )
        self._views: dict[int, tuple[str, ...]] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def fingerprint(self) -> str:
        """Digest the times of change of folders and `transforms.json`; images overwritten in place are not noticed."""
        return folder_stamp(path for folder in self.folders for path in (folder, folder / KEY_FILE))

    def scene_id(self, index: int) -> str:
        return self.scenes[index]

    def view_names(self, index: int) -> tuple[str, ...]:
        if index not in self._views:
            self._views[index] = ItemTransforms.read(self.folders[index]).views
        return self._views[index]

    def geometry(self, index: int) -> ObjectCameras:
        """All cameras of a scene as the file has them: what convention was found, and what they look at."""
        return self._geometry(index, ItemTransforms.read(self.folders[index]))

    def listing(self, index: int) -> Listing:
        folder, transforms = self.folders[index], ItemTransforms.read(self.folders[index])
        depth = (folder / "depth").is_dir()
        files = {
            name: [folder / f"{name}.png", *([folder / "depth" / f"{name}.npz"] if depth else [])]
            for name in transforms.views
        }
        return Listing(self._geometry(index, transforms).normalised(self.distance).c2w, files)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        transforms = ItemTransforms.read(self.folders[index])
        geometry = self._geometry(index, transforms)
        report(self.root, geometry)
        positions = range(len(transforms.views)) if views is None else views
        names = tuple(transforms.views[p] for p in positions)
        files = [self.folders[index] / f"{name}.png" for name in names]
        decoded = [images.decode_with_alpha(file) if truth else (images.decode(file), None) for file in files]
        stored = [image for image, _ in decoded]
        K = [
            self.framing.K(transforms.cameras[p].K(*image.shape[:2]), *image.shape[:2])
            for p, image in zip(positions, stored, strict=True)
        ]
        pixels = stack_pixels([self.framing.image(image) for image in stored], files)
        c2w = geometry.normalised(self.distance).c2w[list(positions)]
        return Scene(
            id=self.scenes[index],
            views=names,
            pixels=pixels,
            cameras=Cameras(torch.from_numpy(c2w).float(), torch.from_numpy(np.stack(K)).float(), *pixels.shape[-2:]),
            near=self.near,
            far=self.far,
            mask=stacked_masks([opaque for _, opaque in decoded], self.framing, by_alpha=True) if truth else None,
            depth=self._depth(files, [image.shape[:2] for image in stored], geometry) if truth else None,
        )

    def _geometry(self, index: int, transforms: ItemTransforms) -> ObjectCameras:
        file = self.folders[index] / KEY_FILE
        return object_cameras(transforms.poses, self.convention, file, transforms.views)

    def _depth(
        self, files: Sequence[Path], sizes: Sequence[tuple[int, int]], geometry: ObjectCameras
    ) -> Float[Tensor, "views height width"] | None:
        """`depth/<view>.npz` in units of the scene; None where the folder is not there."""
        if not (files[0].parent / "depth").is_dir():
            return None
        scale, values = self.distance / geometry.distance, []
        for image, size in zip(files, sizes, strict=True):
            file = image.parent / "depth" / f"{image.stem}.npz"
            depth = read_depth(file)
            if depth.shape != size:
                raise DataError(f"{file}: expected {size[0]}x{size[1]} values as in its image, found {depth.shape}")
            values.append(self.framing.values(scale * depth))
        return torch.from_numpy(np.stack(values))
