"""Clevr3D as published with ObSuRF (Stelzner et al. 2021), and every dataset written in its layout.

    <root>/metadata.npz                        camera_pos [scenes, views, 3], shape [scenes, objects]
    <root>/images/img_<scene>_<view>.png       320×240; numbers are not padded with zeros
    <root>/depths/depths_<scene>_<view>.png    16 bit: distance from the camera, 65536 being 40 units
    <root>/masks/masks_<scene>_<view>.png      labels, 0 being the floor

Cameras are stored as positions alone: they look at the origin, with the z axis of the world up in the image.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from nerfdiff.cameras import Cameras
from nerfdiff.data.formats import images
from nerfdiff.data.formats.npz_files import read_array
from nerfdiff.data.formats.posed_files import ASPECT_TOLERANCE
from nerfdiff.data.readers.framing import Framing, stack_pixels
from nerfdiff.data.readers.index import folder_stamp
from nerfdiff.data.scene import Listing, MissingSplit, Scene
from nerfdiff.poses import look_at_origin
from nerfdiff.utils.errors import ConfigError, DataError, some

PARENTS = ("", "clevr3d")
DEPTH_RANGE = 40.0
"""Distance in scene units that the 2^16 levels of a depth image span: the renderer multiplied by 0.025."""
DEPTH_LEVELS = 2**16


class Clevr3DReader:
    """One split of Clevr3D.

    Of `metadata.npz` only the arrays in use are unpacked, and images are not listed: starting up takes the same
    fraction of a second for ten scenes and for a hundred thousand.

    Args:
        root: the folder that holds `metadata.npz`, or that holds it within `clevr3d/`.
        split: a key of `splits`.
        splits: first scene and end (one past the last scene) of each split.
        near, far: bounds of every scene as distances along rays.
        focal: focal length in pixels of images of `stored_size`; images of another size are the same view at
            another resolution.
        stored_size: (height, width).
        min_objects, max_objects: leave out scenes with fewer or more objects (None: keep all).
        image_size: (height, width), or one side of a square, to resize to; None keeps the stored size.
        crop: (height, width), or one side of a square, to cut out of the middle before; None keeps all.

    Raises:
        ConfigError: settings that make no sense.
        MissingSplit: the dataset ends before the split begins.
        DataError: `root` or its metadata is missing or damaged, the dataset ends within the split, or no scene has
            the wanted number of objects.
    """

    nearest_view = False

    def __init__(
        self,
        root: str | Path,
        split: str,
        splits: Mapping[str, Sequence[int]],
        near: float,
        far: float,
        focal: float,
        stored_size: Sequence[int],
        min_objects: int | None = None,
        max_objects: int | None = None,
        image_size: int | Sequence[int] | None = None,
        crop: int | Sequence[int] | None = None,
    ):
        if not 0 < near < far:
            raise ConfigError(f"near = {near} and far = {far} must satisfy 0 < near < far")
        if not (focal > 0 and len(stored_size) == 2 and min(stored_size) > 0):
            raise ConfigError(
                f"focal = {focal} and stored_size = {list(stored_size)} must be positive, [height, width]"
            )
        self.near, self.far = float(near), float(far)
        self.focal, self.stored_size = float(focal), (int(stored_size[0]), int(stored_size[1]))
        self.framing = Framing.of(crop, image_size)
        first, end = _range_of(split, splits)
        self.folder = _find_root(Path(root))
        self.metadata = self.folder / "metadata.npz"
        positions = camera_positions(self.metadata)
        _check_range(self.metadata, len(positions), split, first, end)
        kept = np.arange(first, end)
        if min_objects is not None or max_objects is not None:
            counts = object_counts(self.metadata, len(positions))[first:end]
            lowest, highest = 0 if min_objects is None else min_objects, np.inf if max_objects is None else max_objects
            kept = kept[(counts >= lowest) & (counts <= highest)]
            if not len(kept):
                raise DataError(
                    f"{self.metadata}: no scene of split {split} has {lowest} to {highest} objects, but {counts.min()} "
                    f"to {counts.max()}; change data.reader.min_objects and max_objects"
                )
        # arrays, not lists: they are sent to every worker
        self.scenes = kept.astype(np.int32)
        self.positions = _look_at_able(self.metadata, kept, positions[kept])
        self._refuse_more_images_than_cameras()
        limits = "" if len(kept) == end - first else f" objects {min_objects} {max_objects}"
        self.identity = (
            f"clevr3d {self.folder.resolve()} {first}:{end}{limits} {self.framing} "
            f"focal {self.focal} at {self.stored_size} bounds {self.near} {self.far}"
        )

    def __len__(self) -> int:
        return len(self.scenes)

    def fingerprint(self) -> str:
        """Digest the metadata and the time at which images last came, went or were renamed.

        Of 300,000 images none is looked at, so one that is overwritten in place goes unnoticed.
        """
        return folder_stamp([self.metadata, self.folder / "images"])

    def scene_id(self, index: int) -> str:
        return str(self.scenes[index])

    def view_names(self, index: int) -> tuple[str, ...]:
        return tuple(map(str, range(self.positions.shape[1])))

    def listing(self, index: int) -> Listing:
        scene, names = self.scene_id(index), self.view_names(index)
        truth = [kind for kind in ("masks", "depths") if (self.folder / kind).is_dir()]
        files = {
            name: [self._image(scene, name), *(self._truth_file(kind, scene, name) for kind in truth)] for name in names
        }
        return Listing(np.stack([look_at_origin(position) for position in self.positions[index]]), files)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        scene, names = self.scene_id(index), self.view_names(index)
        numbers = [range(len(names))[view] for view in (range(len(names)) if views is None else views)]
        files = [self._image(scene, view) for view in numbers]
        stored = [images.decode(file) for file in files]
        sizes = [image.shape[:2] for image in stored]
        K = [self._K(file, *size) for file, size in zip(files, sizes, strict=True)]
        pixels = stack_pixels([self.framing.image(image) for image in stored], files)
        c2w = np.stack([look_at_origin(self.positions[index, view]) for view in numbers])
        framed_K = np.stack([self.framing.K(k, *size) for k, size in zip(K, sizes, strict=True)])
        return Scene(
            id=scene,
            views=tuple(names[view] for view in numbers),
            pixels=pixels,
            cameras=Cameras(torch.from_numpy(c2w).float(), torch.from_numpy(framed_K).float(), *pixels.shape[-2:]),
            near=self.near,
            far=self.far,
            mask=self._truth("masks", scene, numbers, K, sizes) if truth else None,
            depth=self._truth("depths", scene, numbers, K, sizes) if truth else None,
        )

    def _image(self, scene: str, view: int | str) -> Path:
        return self.folder / f"images/img_{scene}_{view}.png"

    def _truth_file(self, kind: str, scene: str, view: int | str) -> Path:
        return self.folder / kind / f"{kind}_{scene}_{view}.png"

    def _K(self, file: Path, height: int, width: int) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of a stored image, whose principal point is its centre."""
        scale, across = width / self.stored_size[1], height / self.stored_size[0]
        if abs(scale / across - 1) > ASPECT_TOLERANCE:
            raise DataError(
                f"{file}: {height}x{width} pixels, of another aspect than {self.stored_size[0]}x{self.stored_size[1]}, "
                "for which the focal length is known; set data.reader.stored_size and data.reader.focal for such images"
            )
        return np.array([[self.focal * scale, 0, width / 2], [0, self.focal * across, height / 2], [0, 0, 1]])

    def _truth(
        self,
        kind: str,
        scene: str,
        views: Sequence[int],
        K: Sequence[Float[np.ndarray, "3 3"]],
        sizes: Sequence[tuple[int, int]],
    ) -> torch.Tensor | None:
        """Masks or depths of these views; None where the dataset is without them."""
        if not (self.folder / kind).is_dir():
            return None
        values = []
        for view, k, size in zip(views, K, sizes, strict=True):
            file = self._truth_file(kind, scene, view)
            levels = images.decode_levels(file)
            if levels.shape != size:
                raise DataError(
                    f"{file}: {levels.shape[0]}x{levels.shape[1]} pixels, its image has {size[0]}x{size[1]}"
                )
            values.append(self.framing.values(levels > 0 if kind == "masks" else _z_depth(file, levels, k)))
        return torch.from_numpy(np.stack(values))

    def _refuse_more_images_than_cameras(self) -> None:
        """Looked up for one scene: the number of views is the same for all."""
        views = self.positions.shape[1]
        extra = self._image(self.scene_id(0), views)
        if extra.exists():
            raise DataError(f"{extra}: an image without a camera: {self.metadata} has {views} cameras per scene")


def _range_of(split: str, splits: Mapping[str, Sequence[int]]) -> tuple[int, int]:
    if split not in splits:
        raise ConfigError(f"split {split!r} is unknown; choose one of {', '.join(splits)} (data.reader.splits)")
    bounds = splits[split]
    whole = len(bounds) == 2 and all(isinstance(bound, int) for bound in bounds)
    if not whole or not 0 <= bounds[0] < bounds[1]:
        raise ConfigError(f"data.reader.splits.{split}={list(bounds)} must be [first scene, one past the last scene]")
    return bounds[0], bounds[1]


def _check_range(metadata: Path, scenes: int, split: str, first: int, end: int) -> None:
    if end > scenes:
        error = MissingSplit if first >= scenes else DataError
        raise error(
            f"{metadata}: {scenes} scenes, but the {split} split is scenes {first} to {end - 1}; for a dataset of "
            f"another size say which scenes are in it: data.reader.splits.{split}=[first,end], with end <= {scenes}"
        )


def _find_root(root: Path) -> Path:
    for parent in PARENTS:
        folder = root / parent
        if (folder / "metadata.npz").is_file():
            if not (folder / "images").is_dir():
                raise DataError(f"{folder / 'images'}: no such folder; expected img_<scene>_<view>.png in it")
            return folder
    wanted = "metadata.npz and images/ (or clevr3d/ with these in it)"
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; set data.root to the folder that holds {wanted}")
    found = sorted(entry.name for entry in root.iterdir())
    raise DataError(f"{root}: expected {wanted}, found {some(found) if found else 'an empty folder'}")


def _look_at_able(
    metadata: Path, scenes: np.ndarray, positions: Float[np.ndarray, "scenes views 3"]
) -> Float[np.ndarray, "scenes views 3"]:
    """The positions, if each gives a camera that looks at the origin with z up."""
    aside = np.linalg.norm(positions[..., :2], axis=-1)
    # NaN fails the comparison; the limit is where single precision loses the direction of the horizontal
    bad = np.argwhere(~(np.isfinite(positions).all(-1) & (aside > 1e-4 * np.abs(positions[..., 2])) & (aside > 0)))
    if len(bad):
        scene, view = bad[0]
        raise DataError(
            f"{metadata}: camera_pos of scene {scenes[scene]}, view {view} is {positions[scene, view].tolist()}; "
            "expected finite positions off the z axis, from which a camera can look at the origin with z up"
        )
    return positions


def _z_depth(file: Path, levels: np.ndarray, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "height width"]:
    """Depth along z from stored distances along rays; 0 where nothing was hit within the range of the file."""
    if levels.dtype.itemsize < 2 or levels.min() < 0 or levels.max() >= DEPTH_LEVELS:
        raise DataError(
            f"{file}: expected a depth image of 16 bits, found {levels.dtype}, {levels.min()} to {levels.max()}"
        )
    height, width = levels.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    distance = np.where(levels < DEPTH_LEVELS - 1, levels * (DEPTH_RANGE / DEPTH_LEVELS), 0)
    return (distance / np.sqrt(1 + x**2 + y[:, None] ** 2)).astype(np.float32)


def camera_positions(metadata: Path) -> Float[np.ndarray, "scenes views 3"]:
    """`camera_pos` in single precision.

    Raises:
        DataError: the file is damaged, or the array missing or of another shape.
    """
    positions = read_array(metadata, "camera_pos", "[scenes, views, 3]")
    if positions.ndim != 3 or positions.shape[2] != 3 or 0 in positions.shape:
        raise DataError(f"{metadata}: expected camera_pos [scenes, views, 3], found shape {list(positions.shape)}")
    with np.errstate(over="ignore"):  # the reader refuses infinite positions with their scene's number
        return positions.astype(np.float32)


def object_counts(metadata: Path, scenes: int) -> Int[np.ndarray, " scenes"]:
    """Count how many of each scene's slots in `shape` hold an object; 0 is an empty slot.

    Raises:
        DataError: as `camera_positions`.
    """
    shape = read_array(metadata, "shape", f"[{scenes}, objects]")
    if shape.ndim != 2 or len(shape) != scenes:
        raise DataError(f"{metadata}: expected shape [{scenes}, objects], found shape {list(shape.shape)}")
    return (shape > 0).sum(1)
