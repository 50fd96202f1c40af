"""One picture of an object, from anywhere, as the source view of a scene of its own."""

import logging
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
from skimage.measure import label

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.formats.images import decode_with_alpha
from nerfdiff.data.readers.masks import read_mask
from nerfdiff.data.scene import Scene
from nerfdiff.inputs import check_mask_size
from nerfdiff.utils.errors import BackgroundError, ConfigError, DataError

log = logging.getLogger(__name__)

VIEW = "input"
MAX_ID = 64
"""Characters of a scene's id: names of files are limited, and folders are named after it."""


@dataclass(frozen=True)
class Picture:
    """A picture of an object, cut out, framed, and given a camera.

    The object is where the mask is white and the picture opaque; without a mask, where a picture with a transparent
    border is opaque; else what is left without the near-white pixels that connect to the border. Of that the largest
    connected part counts, with all others that are not specks beside it. All else becomes white, but for the soft
    edges of a transparent picture. The lens that took the picture is not asked for: the framed picture is taken to be
    seen with `fov`, which should be that of the model's training images.

    Args:
        mask: file of the picture's size, white where the object is; None: by transparency, else by colour.
        open_border: share of the outermost pixels that a mask must leave black, or that must be transparent for a
            picture to count as cut out: rounded corners do not make it so.
        speck: parts smaller than this share of the largest one are left out (dust, watermarks, leftovers).
        smallest: side in pixels that the object's bounding box must reach in one of the two.
        fov: vertical field of view of the framed picture, in degrees; its principal point is the centre.
        near, far: bounds of the object as distances along rays, in scene units.
        object_share: of the frame's height or width, which the object's bounding box is to fill in the one of the two
            that it fills most; None keeps the picture as it is framed, with white beside it up to the frame's aspect
            ratio.
        object_centre: (x, y) of the bounding box's centre, as shares of the frame's width and height; used with
            `object_share`.
        white: level in [0, 1] from which on all three colours of a pixel together count as white.
        white_border: share of the outermost pixels that must be white in a picture that is neither masked nor cut out.

    Raises:
        ConfigError: values that are impossible.
    """

    mask: str | Path | None
    open_border: float
    speck: float
    smallest: int
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
            ("open_border", 0 < self.open_border <= 1, "a share within (0, 1]"),
            ("speck", 0 <= self.speck <= 1, "a share within [0, 1]"),
            ("smallest", self.smallest >= 1, "at least 1 pixel"),
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

    def load(
        self, path: str | Path, image_size: Sequence[int], where: Bool[np.ndarray, "rows columns"] | None = None
    ) -> ViewBatch:
        """The picture as a batch of one scene, named after the file, whose only target is the source view itself.

        Args:
            image_size: (height, width) of the model's images.
            where: the object is, in the picture's pixels; None: `mask` or the picture says so.

        Raises:
            BackgroundError: it does not tell object from background.
            DataError: the picture or its mask cannot be read, they differ in size, the mask is empty or covers the
                border, or the picture shows no object.
        """
        path, (height, width) = Path(path), image_size
        pixels, where = self._cut_out(path, where)
        framed = area_resample(pixels, self._window(where, height, width), (height, width))
        if self._near_white(framed).all():
            raise DataError(f"{path}: no object in it; framed at {height}x{width} it is white all over")
        framed = torch.from_numpy(framed).movedim(-1, 0)
        focal = height / 2 / math.tan(math.radians(self.fov) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras = Cameras(torch.eye(4)[None], K[None], height, width)
        scene = Scene(scene_id(path), (VIEW,), framed[None], cameras, float(self.near), float(self.far))
        return ViewBatch.collate([Sample(scene, source=0, targets=[0], draw=0)])

    def _cut_out(
        self, path: Path, where: Bool[np.ndarray, "height width"] | None
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
        """The picture with white around the object, and where the object is."""
        pixels, opaque = decode_with_alpha(path, upright=True)
        white = self._near_white(pixels)
        edges = False  # where something may show beside the object
        if where is not None:
            pass
        elif self.mask is not None:
            where = self._masked(path, pixels.shape[:2])
            where = where if opaque is None else where & opaque
        elif opaque is not None and _of_border(~opaque) >= self.open_border:
            where, edges = opaque, ~opaque & ~white
        else:
            self._refuse_background(path, white, opaque)
            where = ~_reached(white, _border(white.shape), connectivity=1)
        if not where.any():
            raise DataError(
                f"{path}: no object in it; all of it is transparent, masked out or white. Give a picture, or a "
                "picture.mask, with an object"
            )
        kept = self._without_specks(path, where)
        shown = _reached(kept | edges, kept)
        return np.where(shown[..., None], pixels, np.uint8(255)), kept

    def _near_white(self, pixels: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        return (pixels >= 255 * self.white).all(-1)

    def _masked(self, path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """Read where the mask of `path`, of `size`, has the object."""
        where = _upright(read_mask(Path(self.mask)), Path(self.mask))
        check_mask_size(str(self.mask), where.shape, str(path), size)
        covered = _of_border(where)
        if where.all() or not where.any() or 1 - covered < self.open_border:
            found = f"white on {covered:.0%} of its border" if where.any() else "all black"
            found = "all white" if where.all() else found
            raise DataError(
                f"{self.mask}: expected white where the object of {path} is and black around it, found a mask that is "
                f"{found}. Is it inverted, or of another picture? Give one that is black on at least "
                f"{self.open_border:.0%} of its border"
            )
        return where

    def _refuse_background(
        self, path: Path, white: Bool[np.ndarray, "height width"], opaque: Bool[np.ndarray, "height width"] | None
    ) -> None:
        if (found := _of_border(white)) < self.white_border:
            clear = 0.0 if opaque is None else _of_border(~opaque)
            raise BackgroundError(
                f"{path}: {1 - found:.0%} of its border is not white, and only {clear:.0%} is transparent, so object "
                "and background cannot be told apart. Give an RGBA picture with a transparent background, or "
                "picture.mask=<image of its size, white where the object is>, or a picture on white; "
                "or let picture.py cut it out"
            )

    def _without_specks(self, path: Path, where: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
        """The largest connected part of `where` and those of at least its share; says which box they fill."""
        parts, count = label(where, return_num=True, connectivity=2)
        sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
        large = sizes >= self.speck * sizes.max()
        kept = np.concatenate([[False], large])[parts]
        top, bottom, left, right = _box(kept)
        said = f"rows {top} to {bottom}, columns {left} to {right} of {where.shape[0]}x{where.shape[1]}"
        if max(bottom - top, right - left) < self.smallest:
            raise DataError(
                f"{path}: no object in it; the largest part that is not background is {bottom - top}x{right - left} "
                f"pixels ({said}), expected at least {self.smallest} one way (picture.smallest)"
            )
        specks = f"; left out {(~large).sum()} specks of {sizes[~large].sum()} pixels" if not large.all() else ""
        log.info("%s: the object fills %s%s", path, said, specks)
        return kept

    def _window(
        self, where: Bool[np.ndarray, "rows columns"], height: int, width: int
    ) -> tuple[float, float, float, float]:
        """(top, left, height, width), in the picture's pixels, of what becomes an image of `height` × `width`."""
        aspect = width / height
        if self.object_share is None:
            rows, columns = where.shape
            tall = max(rows, columns / aspect)
            return (rows - tall) / 2, (columns - tall * aspect) / 2, tall, tall * aspect
        return window_around(where, aspect, self.object_share, self.object_centre)


def window_around(
    where: Bool[np.ndarray, "rows columns"], aspect: float, share: float, centre: Sequence[float]
) -> tuple[float, float, float, float]:
    """(top, left, height, width) of a window that an object fills to a share, around a point; see `Picture`."""
    top, bottom, left, right = _box(where)
    tall = max(bottom - top, (right - left) / aspect) / share
    x, y = centre
    return (top + bottom) / 2 - y * tall, (left + right) / 2 - x * tall * aspect, tall, tall * aspect


def _border(shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """The outermost pixels."""
    border = np.ones(shape, bool)
    border[1:-1, 1:-1] = False
    return border


def _of_border(where: Bool[np.ndarray, "height width"]) -> float:
    """Share of the outermost pixels."""
    return float(where[_border(where.shape)].mean())


def _box(where: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """(top, bottom, left, right), the ends exclusive."""
    (top, bottom), (left, right) = (np.flatnonzero(where.any(axis))[[0, -1]].tolist() for axis in (1, 0))
    return top, bottom + 1, left, right + 1


def _reached(
    where: Bool[np.ndarray, "height width"], start: Bool[np.ndarray, "height width"], connectivity: int = 2
) -> Bool[np.ndarray, "height width"]:
    """The connected parts of `where` that hold a pixel of `start`; by sides alone (1), or by corners too (2)."""
    parts = label(where, connectivity=connectivity)
    return where & np.isin(parts, np.unique(parts[start & where]))


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
    """Compute the share of each new pixel, `step` old ones wide, on each old one; widened to 1 it is a tent's."""
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
