"""Scenes described by `transforms.json` (nerfstudio, instant-ngp) or `transforms_{train,val,test}.json` (Blender).

    {"fl_x", "fl_y", "cx", "cy", "w", "h", "frames": [{"file_path": "images/1.jpg", "transform_matrix", "mask_path"}]}
    {"camera_angle_x", "frames": [{"file_path": "./train/r_0", "transform_matrix"}]}

Intrinsics, and distortion (`lens.Lens`), may stand in a frame as well as beside the frames, and in other spellings
(`camera_keys`). `transform_matrix` is camera-to-world with OpenGL axes (x right, y up, looking along −z). Where both
kinds of file are there, `transforms.json` is read.
"""

import logging
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.camera_keys import camera_keys, frame_camera
from nerfdiff.data.formats.json_files import entry, matrix, optional_number, read_json
from nerfdiff.data.formats.lens import Lens
from nerfdiff.data.formats.posed_files import check_rigid
from nerfdiff.data.formats.transforms_pinhole import Pinhole
from nerfdiff.utils.errors import DataError

ONE_FILE = "transforms.json"
SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
SINGLE_PRECISION = 1e-4
"""Smallest extent of the cameras, relative to their distance from the world's origin, that survives fp32."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One view.

    Args:
        name: file stem; where stems occur twice, the path within the scene with "_" for "/".
        image, mask: files, as they are listed until `Transforms.found`.
        c2w: camera-to-world with OpenCV axes.
        pinhole: its intrinsics.
        lens: its distortion; None where there is none.
    """

    name: str
    image: Path
    mask: Path | None
    c2w: Float[np.ndarray, "4 4"]
    pinhole: Pinhole
    lens: Lens | None


@dataclass(frozen=True)
class Transforms:
    """All views of a scene in natural order of their names (r_2 before r_10).

    Args:
        near, far: bounds along rays, where a file states them.
    """

    frames: tuple[Frame, ...]
    near: float | None
    far: float | None

    @property
    def c2w(self) -> Float[np.ndarray, "views 4 4"]:
        return np.stack([frame.c2w for frame in self.frames])

    def found(self, folder: Path, skip: bool) -> "Transforms":
        """With the files that are there for those that are listed, see `find_image`.

        Args:
            folder: the scene's, for messages.
            skip: leave out frames whose image or mask is missing, with one warning.

        Raises:
            DataError: some are missing and not to be left out, or all are.
        """
        frames, missing = [], []
        for frame in self.frames:
            image, mask = find_image(frame.image), None if frame.mask is None else find_image(frame.mask)
            lost = [listed for listed, file in ((frame.image, image), (frame.mask, mask)) if listed and not file]
            missing += lost[:1]
            if not lost:
                frames.append(replace(frame, image=image, mask=mask))
        if not missing:
            return replace(self, frames=tuple(frames))
        named = ", ".join(str(file).removeprefix(f"{folder}/") for file in missing[:3])
        text = f"{folder}: {len(missing)} of {len(self.frames)} listed images or their masks are not there: {named}"
        text += f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        if not frames or not skip:
            instead = ", or set data.reader.missing_images=skip to go on without these frames" if frames else ""
            raise DataError(
                f"{text}; looked for as they are listed, in other capitals, and without suffix also as "
                f"{', '.join(IMAGE_SUFFIXES)}. Put them there{instead}"
            )
        _warn_once(f"{text}; going on without these frames")
        return replace(self, frames=tuple(frames))


def is_scene(folder: Path) -> bool:
    """Return true if the folder holds one of the files."""
    return any((folder / name).is_file() for name in (ONE_FILE, *SPLIT_FILES))


def read_transforms(folder: Path, convention: str = "opengl") -> Transforms:
    """Read the views of a scene folder; the views of all three Blender files are views of one scene.

    Args:
        convention: axes of the poses in the file, "opengl" or "opencv".

    Raises:
        DataError: there is no such file; or one is damaged, has no frames, poses that are not rigid, wrong or no
            intrinsics, a lens that is not read, or a view twice.
    """
    names = [ONE_FILE] if (folder / ONE_FILE).is_file() else [n for n in SPLIT_FILES if (folder / n).is_file()]
    if not names:
        raise DataError(
            f"{folder}: no {ONE_FILE} and no {', '.join(SPLIT_FILES)}; expected one of them in every scene's folder"
        )
    frames, near, far = [], None, None
    for file in (folder / name for name in names):
        content = read_json(file, "expected posed images as a JSON object with the key 'frames'")
        frames += _frames(file, content, convention)
        near = optional_number(content, "near", file) if near is None else near
        far = optional_number(content, "far", file) if far is None else far
    frames = _named(folder / names[0], frames)
    _refuse_far_away(folder / names[0], np.stack([frame.c2w[:3, 3] for frame in frames]))
    return Transforms(tuple(frames), near, far)


def find_image(path: Path) -> Path | None:
    """The file itself, or, for a path without suffix, the image beside it that has one; else None.

    Capitals, and how accents are composed, need not be those of the file's name: other systems do not tell them apart.
    """
    suffixes = ("",) if path.suffix.lower() in IMAGE_SUFFIXES else ("", *IMAGE_SUFFIXES)
    names = [path.name + suffix for suffix in suffixes]
    found = next((file for file in map(path.with_name, names) if file.is_file()), None)
    if found is not None or not path.parent.is_dir():
        return found
    others = _folded_names(path.parent, path.parent.stat().st_mtime_ns)
    alike = [path.with_name(others[_folded(name)]) for name in names if _folded(name) in others]
    return next((file for file in alike if file.is_file()), None)


@lru_cache(maxsize=4)
def _folded_names(folder: Path, changed: int) -> dict[str, str]:
    """Names in a folder, last changed then, by what they have in common with others like them."""
    return {_folded(name): name for name in sorted(os.listdir(folder), reverse=True)}


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


@lru_cache
def _warn_once(text: str) -> None:
    log.warning(text)


def _frames(file: Path, content: Mapping[str, Any], convention: str) -> list[Frame]:
    listed = entry(content, "frames", list, file)
    if not listed:
        raise DataError(f"{file}: 'frames' is empty; expected one entry per image")
    shared, frames = camera_keys(content, str(file)), []
    for position, frame in enumerate(listed):
        where = f"{file}: frames[{position}]"
        path = _relative(entry(frame, "file_path", str, where), "file_path", where)
        where = f"{where} ({path})"
        c2w = _pose(entry(frame, "transform_matrix", list, where), where)
        if convention == "opengl":
            c2w = c2w * [1, -1, -1, 1]
        camera, mask = frame_camera(shared, camera_keys(frame, where)), None
        if "mask_path" in camera:
            mask = file.parent / _relative(entry(camera, "mask_path", str, where), "mask_path", where)
        lens, pinhole = Lens.read(camera, where), Pinhole.read(camera, where)
        frames.append(Frame(str(path), file.parent / path, mask, c2w, pinhole, lens))
    return frames


def _relative(text: str, key: str, where: str) -> PurePosixPath:
    path = PurePosixPath(text.replace("\\", "/"))
    if not path.name or path.name.startswith(".") or not text.isprintable():
        raise DataError(f"{where}: {text[:80]!r} as {key!r} names no file")
    return path


def _pose(value: list, where: str) -> Float[np.ndarray, "4 4"]:
    if len(value) == 3:  # the last row may be left out
        value = [*value, [0, 0, 0, 1]]
    pose = matrix(value, 4, 4, where)
    check_rigid(pose, where)
    return pose


def _named(file: Path, frames: Sequence[Frame]) -> list[Frame]:
    """Frames, until now named by their paths, with the names of their views and in the order of these."""
    paths = [_without_suffix(PurePosixPath(frame.name)) for frame in frames]
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        names = ["_".join(part for part in path.parts if part not in ("/", "..")) for path in paths]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise DataError(f"{file}: {len(twice)} views are there twice, first {twice[0]}; expected one frame per image")
    named = [replace(frame, name=name) for name, frame in zip(names, frames, strict=True)]
    return sorted(named, key=lambda frame: (re.sub(r"\d+", lambda digits: digits[0].zfill(20), frame.name), frame.name))


def _without_suffix(path: PurePosixPath) -> PurePosixPath:
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def _refuse_far_away(file: Path, centres: Float[np.ndarray, "views 3"]) -> None:
    """Geographic coordinates, say, would lose in single precision what tells cameras apart."""
    extent = np.abs(centres - centres.mean(0)).max()
    distance = np.abs(centres).max()
    if 0 < extent < SINGLE_PRECISION * distance:
        raise DataError(
            f"{file}: the cameras lie within {extent:.3g} of each other and {distance:.3g} from the world's origin, "
            "too far for single precision; subtract their mean position from all poses"
        )
