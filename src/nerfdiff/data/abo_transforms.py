"""`transforms.json` of ABO's 30-view renders: one pose and one Blender camera per frame."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.data.blender_camera import BlenderCamera
from nerfdiff.data.json_files import entry, matrix, read_list
from nerfdiff.errors import DataError, some

KEY_FILE = "transforms.json"
IMAGES = r"{item}_\d+\.png"


@dataclass(frozen=True)
class ItemTransforms:
    """What the file says of its views, in the order of the numbers at the ends of their names."""

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
