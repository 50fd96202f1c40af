"""One picture of an object, from anywhere, as the source view of a scene of its own."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.images import decode_with_alpha
from nerfdiff.data.masks import read_mask
from nerfdiff.data.scene import Scene
from nerfdiff.errors import ConfigError, DataError

VIEW = "input"
MAX_ID = 64
"""Characters of a scene's id: names of files are limited, and folders are named after it."""


@dataclass(frozen=True)
class Picture:
    """How a picture is cut out, framed and seen.

    The object is where the picture is opaque and the mask is white; without either, where it is not white. All else
    becomes white. The lens that took the picture is not asked for: the framed picture is taken to be seen with `fov`,
    which should be that of the model's training images.

    Args:
        mask: file of the picture's size, white where the object is; None: by transparency, else by colour.
        fov: vertical field of view of the framed picture, in degrees; its principal point is the centre.
        near, far: bounds of the object as distances along rays, in scene units.
        object_share: of the frame's height or width, which the object's bounding box is to fill in the one of the two
            that it fills most; None keeps the picture as it is framed, with white beside it up to the frame's aspect
            ratio.
        object_centre: (x, y) of the bounding box's centre, as shares of the frame's width and height; used with
            `object_share`.
        white: level in [0, 1] from which on all three colours of a pixel together count as white.
        white_border: share of the outermost pixels that must be white in a picture with neither mask nor transparency.

    Raises:
        ConfigError: values that are impossible.
    """

    mask: str | Path | None
    fov: float
    near: float
    far: float
    object_share: float | None
    object_centre: Sequence[float]
    white: float
    white_border: float

    def __post_init__(self):
        share = 1.0 if self.object_share is None else self.object_share
        for key, possible, expected in (
            ("fov", 0 < self.fov < 180, "degrees within (0, 180)"),
            ("near", 0 < self.near < self.far < math.inf, f"0 < near < far={self.far}"),
            ("object_share", 0 < share <= 1, "a share within (0, 1], or null"),
            (
                "object_centre",
                len(self.object_centre) == 2 and all(0 < c < 1 for c in self.object_centre),
                "[x, y] within (0, 1)",
            ),
            ("white", 0 < self.white <= 1, "a level within (0, 1]"),
            ("white_border", 0 <= self.white_border <= 1, "a share within [0, 1]"),
        ):
            if not possible:
                raise ConfigError(f"picture.{key}={getattr(self, key)}: expected {expected}")

    def load(self, path: str | Path, image_size: Sequence[int]) -> ViewBatch:
        """The picture as a batch of one scene, named after the file, whose only target is the source view itself.

        Args:
            image_size: (height, width) of the model's images.

        Raises:
            DataError: the picture or its mask cannot be read, they differ in size, the picture shows no object, or it
                does not tell object from background.
        """
        path, (height, width) = Path(path), image_size
        pixels, where = self._cut_out(path)
        window = self._window(where, height, width)
        framed = torch.from_numpy(area_resample(pixels, window, (height, width))).movedim(-1, 0)
        focal = height / 2 / math.tan(math.radians(self.fov) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras = Cameras(torch.eye(4)[None], K[None], height, width)
        scene = Scene(scene_id(path), (VIEW,), framed[None], cameras, float(self.near), float(self.far))
        return ViewBatch.collate([Sample(scene, source=0, targets=[0], draw=0)])

    def _cut_out(self, path: Path) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
        """The picture with white around the object, and where the object is."""
        pixels, opaque = decode_with_alpha(path, upright=True)
        told = opaque is not None and not opaque.all()  # many programs write an alpha that says nothing
        where = opaque if told else (pixels < 255 * self.white).any(-1)
        if self.mask is not None:
            mask = _upright(read_mask(Path(self.mask)), Path(self.mask))
            if mask.shape != pixels.shape[:2]:
                (h, w), (rows, columns) = mask.shape, pixels.shape[:2]
                raise DataError(
                    f"{self.mask}: a mask of {h}x{w} for {path} of {rows}x{columns} (height x width); expected one size"
                )
            pixels = np.where(mask[..., None], pixels, np.uint8(255))
            where = where & mask if told else mask
        elif not told:
            self._refuse_background(path, where)
        if not where.any():
            raise DataError(
                f"{path}: no object in it; all of it is transparent, masked out or white. Give a picture, or a "
                "picture.mask, with an object"
            )
        return pixels, where

    def _refuse_background(self, path: Path, where: Bool[np.ndarray, "height width"]) -> None:
        border = np.concatenate([where[0], where[-1], where[1:-1, 0], where[1:-1, -1]])
        if 1 - border.mean() < self.white_border:
            raise DataError(
                f"{path}: {border.mean():.0%} of its border is not white, and it has no transparent part, so object "
                "and background cannot be told apart. Give an RGBA picture with a transparent background, or "
                "picture.mask=<image of its size, white where the object is>, or a picture on white"
            )

    def _window(
        self, where: Bool[np.ndarray, "rows columns"], height: int, width: int
    ) -> tuple[float, float, float, float]:
        """(top, left, height, width), in the picture's pixels, of what becomes an image of `height` × `width`."""
        aspect = width / height
        if self.object_share is None:
            rows, columns = where.shape
            tall = max(rows, columns / aspect)
            return (rows - tall) / 2, (columns - tall * aspect) / 2, tall, tall * aspect
        (top, bottom), (left, right) = (np.flatnonzero(where.any(axis))[[0, -1]] + [0, 1] for axis in (1, 0))
        tall = max(bottom - top, (right - left) / aspect) / self.object_share
        x, y = self.object_centre
        return (top + bottom) / 2 - y * tall, (left + right) / 2 - x * tall * aspect, tall, tall * aspect


def scene_id(path: Path) -> str:
    """The file's name without its ending, as a name for a folder."""
    return re.sub(r"[^\w.-]+", "_", path.stem).strip("._")[:MAX_ID] or "picture"


def area_resample(
    pixels: UInt8[np.ndarray, "height width 3"],
    window: tuple[float, float, float, float],
    size: tuple[int, int],
) -> UInt8[np.ndarray, "new_height new_width 3"]:
    """Resample a part of an image on white: exact area averages where it shrinks, linear interpolation where it grows.

    Args:
        window: (top, left, height, width) in pixels, whole or not; what lies beyond the image is white.
        size: (height, width) in new pixels.
    """
    rows = _overlaps(window[0], window[2] / size[0], size[0], pixels.shape[0])
    columns = _overlaps(window[1], window[3] / size[1], size[1], pixels.shape[1])
    # averaging what is missing to white leaves white wherever there is no pixel
    ink = np.stack([rows @ (255 - pixels[..., c]).astype(np.float32) @ columns.T for c in range(3)], -1)
    return np.rint(255 - ink.clip(0, 255)).astype(np.uint8)


def _overlaps(start: float, step: float, new: int, old: int) -> Float[np.ndarray, "new old"]:
    """How much of each new pixel, `step` old ones wide, lies on each old one; widened to 1 it is a tent's weight."""
    centres = start + (np.arange(new) + 0.5) * step
    reach = max(step, 1.0)
    distances = np.abs(centres[:, None] - (np.arange(old) + 0.5))
    return (((reach + 1) / 2 - distances).clip(0, 1) / reach).astype(np.float32)


def _upright(values: np.ndarray, path: Path) -> np.ndarray:
    """Turn what was decoded from `path` as its EXIF orientation says."""
    with Image.open(path) as stored:
        orientation = stored.getexif().get(Base.Orientation, 1)
    image = Image.fromarray(values)
    image.getexif()[Base.Orientation] = orientation
    return np.asarray(ImageOps.exif_transpose(image))
