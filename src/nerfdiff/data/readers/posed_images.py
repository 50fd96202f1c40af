"""A person's own posed images: one folder per scene, with nerfstudio's or Blender-synthetic's `transforms*.json`.

    <root>/{train,val,test}/<scene>/transforms.json     splits as they are laid out
    <root>/<scene>/transforms.json                      splits drawn from a seed
    <root>/transforms.json                              one scene, which is every split

What the files hold is said in `transforms_json`. Images of lenses that distort are undistorted as they are read,
with their K and size kept (`lens.Lens`). Scenes may have any scale: density is per depth of the frustum, and
near and far come from each scene's own cameras.
"""

import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from nerfdiff.cameras import Cameras
from nerfdiff.data.formats import images
from nerfdiff.data.formats.posed_files import MAX_POSITION
from nerfdiff.data.formats.transforms_json import ONE_FILE, SPLIT_FILES, Frame, Transforms, is_scene, read_transforms
from nerfdiff.data.readers.bounds import Gaze
from nerfdiff.data.readers.framing import Framing, stack_pixels
from nerfdiff.data.readers.index import folder_stamp
from nerfdiff.data.readers.masks import likely_misreading, read_mask, stacked_masks
from nerfdiff.data.readers.split_file import draw_split
from nerfdiff.data.scene import Listing, MissingSplit, Scene
from nerfdiff.utils.errors import ConfigError, DataError

CONVENTIONS = ("opengl", "opencv")
MISSING_IMAGES = ("error", "skip")
KEPT_SCENES = 256
"""Scenes whose JSON is remembered, so that the memory of a process does not grow with the dataset."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _PosedScene:
    """A scene's views, parsed and checked."""

    transforms: Transforms
    near: float
    far: float


class PosedImagesReader:
    """One split of a person's own scenes.

    Args:
        root: the folder of the scenes, of their splits, or of a single scene.
        split: "train", "val" or "test".
        near, far: bounds of every scene as distances along rays, in units of the poses. Where None they are those
            that a scene's file states as "near" and "far", or are estimated from its cameras (`bounds.Gaze`). (An
            "aabb_scale" is no bound: real captures state one much larger than what they show.)
        convention: axes of the poses, "opengl" as the formats have it, or "opencv".
        inward: refuse scenes most of whose cameras look away from where their optical axes meet.
        white_background: make white what a frame's mask leaves out; without, masks serve as ground truth only.
            Transparency always lies on white.
        split_sizes: proportions of the splits, where scenes lie side by side.
        split_seed: which scenes those are; they depend on the names of all scenes, so a new scene may move others.
        image_size: (height, width), or one side of a square, to resize to, each image with intrinsics of its own;
            None keeps the stored size.
        crop: (height, width), or one side of a square, to cut out of the middle before; None keeps all.
        missing_images: "error" or "skip" frames whose image or mask is not there.
        inverted_masks: white marks the background in a frame's mask, as instant-ngp has it.
        max_mask_border: share of the border that masks of objects may cover (`masks.likely_misreading`): a scene that
            is read as a whole is refused where its masks look misread; None refuses none.

    Raises:
        ConfigError: settings that make no sense.
        MissingSplit: `root` has no such split, or too few scenes for it.
        DataError: `root` is missing or empty, or its first scene is damaged.
    """

    nearest_view = True  # frames are numbered as they were taken, and some are lost on the way

    def __init__(
        self,
        root: str | Path,
        split: str,
        near: float | None,
        far: float | None,
        convention: str,
        inward: bool,
        white_background: bool,
        split_sizes: Mapping[str, int],
        split_seed: int,
        image_size: int | Sequence[int] | None = None,
        crop: int | Sequence[int] | None = None,
        missing_images: str = "error",
        inverted_masks: bool = False,
        max_mask_border: float | None = 0.5,
    ):
        if not all(bound is None or bound > 0 for bound in (near, far)) or (near and far and near >= far):
            raise ConfigError(f"near = {near} and far = {far} must satisfy 0 < near < far, or be null")
        if convention not in CONVENTIONS:
            raise ConfigError(f"convention {convention!r} is unknown; choose one of {', '.join(CONVENTIONS)}")
        if missing_images not in MISSING_IMAGES:
            raise ConfigError(
                f"missing_images {missing_images!r} is unknown; choose one of {', '.join(MISSING_IMAGES)}"
            )
        self.near, self.far, self.missing_images = near, far, missing_images
        self.convention, self.inward, self.white_background = convention, inward, white_background
        self.inverted_masks, self.max_mask_border = inverted_masks, max_mask_border
        self.framing = Framing.of(crop, image_size)
        root = Path(root)
        self.folders = find_scenes(root, split, split_sizes, split_seed)
        self.identity = (
            f"posed_images {root.resolve()} {split} {dict(split_sizes)} {split_seed} {self.framing} {convention} "
            f"bounds {near} {far} white {white_background} missing {missing_images} inverted masks {inverted_masks}"
        )
        self._parsed: dict[int, _PosedScene] = {}
        first = self._scene(0)
        if near is None or far is None:
            log.info(
                "%s split of %s: near and far of each scene are read from its file or estimated from its cameras; "
                "those of %s are %.4g and %.4g. data.reader.near and data.reader.far set them for all",
                split,
                root,
                self.scene_id(0),
                first.near,
                first.far,
            )

    def __len__(self) -> int:
        return len(self.folders)

    def fingerprint(self) -> str:
        """Digest the times of change of each scene's folder and what lies directly in it.

        That is its JSON files and the folders of its images, so an image overwritten in place goes unnoticed.
        """
        return folder_stamp(path for folder in self.folders for path in (folder, *_visible(folder)))

    def scene_id(self, index: int) -> str:
        return Path(os.path.abspath(self.folders[index])).name  # the folder may be "."

    def view_names(self, index: int) -> tuple[str, ...]:
        return tuple(frame.name for frame in self._scene(index).transforms.frames)

    def listing(self, index: int) -> Listing:
        transforms = self._scene(index).transforms
        files = {f.name: [f.image, *([] if f.mask is None else [f.mask])] for f in transforms.frames}
        return Listing(transforms.c2w, files)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        scene = self._scene(index)
        every = scene.transforms.frames
        frames = every if views is None else [every[view] for view in views]
        opened = [self._open(frame, truth) for frame in frames]
        masks, by_alpha = [mask for _, mask, _ in opened], all(frame.mask is None for frame in frames)
        if views is None and self.white_background and not by_alpha:
            self._refuse_misread(index, [mask for mask, frame in zip(masks, frames, strict=True) if frame.mask])
        pixels = stack_pixels([self.framing.image(image) for image, _, _ in opened], [frame.image for frame in frames])
        K = [self.framing.K(k, *image.shape[:2]) for image, _, k in opened]
        c2w = np.stack([frame.c2w for frame in frames])
        return Scene(
            id=self.scene_id(index),
            views=tuple(frame.name for frame in frames),
            pixels=pixels,
            cameras=Cameras(torch.from_numpy(c2w).float(), torch.from_numpy(np.stack(K)).float(), *pixels.shape[-2:]),
            near=scene.near,
            far=scene.far,
            mask=stacked_masks(masks, self.framing, by_alpha) if truth else None,
        )

    def _open(
        self, frame: Frame, truth: bool
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"] | None, Float[np.ndarray, "3 3"]]:
        """A frame's image, its foreground by mask or else, where `truth` asks for it, by transparency, and its K."""
        image, opaque = images.decode_with_alpha(frame.image, frame.pinhole.size)
        opaque = opaque if truth else None
        K, mask = frame.pinhole.K(*image.shape[:2]), self._mask(frame, image.shape[:2])
        foreground = opaque if mask is None else mask
        if frame.lens is not None:
            image = frame.lens.image(image, K)
            foreground = None if foreground is None else frame.lens.mask(foreground, K)
        if self.white_background and mask is not None:
            image = np.where(foreground[..., None], image, np.uint8(255))
        return image, foreground, K

    def _scene(self, index: int) -> _PosedScene:
        parsed = self._parsed.get(index)
        if parsed is None:
            parsed = self._parse(self.folders[index])
            if len(self._parsed) >= KEPT_SCENES:
                self._parsed.clear()
            self._parsed[index] = parsed
        return parsed

    def _parse(self, folder: Path) -> _PosedScene:
        transforms = read_transforms(folder, self.convention).found(folder, skip=self.missing_images == "skip")
        gaze = Gaze.of(transforms.c2w)
        if self.inward:
            gaze.refuse_outward(folder, self.convention)
        near = self.near if self.near is not None else transforms.near
        far = self.far if self.far is not None else transforms.far
        if near is None or far is None:
            estimated = gaze.bounds(_half_angle(transforms.frames), folder)
            strays = gaze.describe_strays([frame.name for frame in transforms.frames])
            if strays is not None:
                log.warning(
                    "%s: %s; near and far are estimated without them. Mend their poses, or set data.reader.near and "
                    "data.reader.far if they are right",
                    folder,
                    strays,
                )
            near, far = estimated[0] if near is None else near, estimated[1] if far is None else far
        if not 0 < near < far < MAX_POSITION:
            raise DataError(
                f"{folder}: near = {near:g} and far = {far:g}, partly stated and partly estimated, are no bounds; "
                "expected 0 < near < far; set both data.reader.near and data.reader.far"
            )
        return _PosedScene(transforms, float(near), float(far))

    def _mask(self, frame: Frame, size: tuple[int, int]) -> Bool[np.ndarray, "height width"] | None:
        if frame.mask is None:
            return None
        mask = read_mask(frame.mask)
        if mask.shape != size:
            raise DataError(
                f"{frame.mask}: {mask.shape[0]}x{mask.shape[1]} pixels, its image {frame.image.name} has "
                f"{size[0]}x{size[1]}"
            )
        return ~mask if self.inverted_masks else mask

    def _refuse_misread(self, index: int, masks: Sequence[Bool[np.ndarray, "_ _"]]) -> None:
        """Before a misread mask leaves white images, or paints the object white."""
        reason = None if self.max_mask_border is None else likely_misreading(masks, self.max_mask_border)
        if reason is not None:
            raise DataError(
                f"{self.folders[index]}: {reason}. Where masks are white for the background, set "
                f"data.reader.inverted_masks={str(not self.inverted_masks).lower()}; where they are right, "
                "data.reader.max_mask_border=null; to leave images as they are, data.reader.white_background=false"
            )


def _half_angle(frames: Sequence[Frame]) -> float:
    """Half the widest field of view among the frames, along the wider side of an image as it is stored.

    Where no size is stated, frames that share their intrinsics share the size of the first one's image.
    """
    widest = 0.0
    cameras = {(f.pinhole.focal, f.pinhole.angle, f.pinhole.centre, f.pinhole.size): f for f in reversed(frames)}
    for frame in cameras.values():
        height, width = map(round, frame.pinhole.size or images.stored_size(frame.image))
        K = frame.pinhole.K(height, width)
        widest = max(widest, math.atan(max(width / K[0, 0], height / K[1, 1]) / 2))
    return widest


def _visible(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return sorted(Path(entry.path) for entry in entries if not entry.name.startswith("."))
    except OSError as error:
        raise DataError(f"{folder}: the scene's folder cannot be listed ({error.strerror})") from error


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
