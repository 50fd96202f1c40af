"""Mixed products in the layout of ABO's public 30-view renders, with depth beside the colours.

    <root>/<item>/transforms.json
        {"obj_path", "frames": [{"file_path", "transform_matrix" 4×4, "camera": {"angle_x", …}}]}
        file_path: no extension; transform_matrix: cam2world, Blender's axes (y up, looking along −z)
    <root>/<item>/<item>_00.png …      RGBA, alpha the coverage, 8 or 16 bits (the public script writes 16)
    <root>/<item>/depth/<item>_00.npz  array `depth`, float32: distance along z in scene units, 0 where nothing
                                       was hit (not part of the public renders)

An item's folder appears under its name only when it is complete.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt
from PIL import Image

from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import publish
from procedural.colour import rgba
from procedural.kinds.kind import SceneJob, check_splits, check_styles, stream
from procedural.mesh import Model
from procedural.mitsuba_model import ModelWorld
from procedural.mitsuba_renderer import Film, MitsubaRenderer
from procedural.poses import look_at
from procedural.products.catalogue import STYLES, build_product
from procedural.root_folder import half_written

VIEWS = 30
FOV = 40.0
# Half the angle of view spans the largest half-extent 1.8 times: 4.9455 of them away.
DISTANCE = 1.8 / np.tan(np.radians(FOV) / 2)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def directions() -> Float[np.ndarray, "30 3"]:
    """From the object's centre to the cameras, the same for every item.

    Drawn as ABO's public render script draws them, anew from one seed for each item: uniform on the sphere
    from straight above to 10° below the horizon. That the released renders were made by that very version of
    the script is not confirmed.
    """
    rng, found = np.random.default_rng(0xAAAA_AAAA_AAAA_AAAA), []
    top, lowest = np.cos(np.radians([0, 100]))
    for _ in range(VIEWS):
        u, _, v = rng.uniform(0, 1, 3)
        rng.uniform()  # the script draws a field of view too, from an interval of no length
        z, turn = top + u * (lowest - top), 2 * np.pi * v
        across = np.sqrt(1 - z**2)
        found.append((across * np.sin(turn), -across * np.cos(turn), z))
    return np.array(found)


def item_id(seed: int, index: int) -> str:
    """Ten characters as a shop's article number, different for every index."""
    count = len(DIGITS) ** 7
    # A factor with no divisor in common with 36 visits every number once.
    number = (index * 31415926535 + seed * 27182818285 + 16180339887) % count
    return "B07" + "".join(DIGITS[number // len(DIGITS) ** k % len(DIGITS)] for k in reversed(range(7)))


@dataclass(frozen=True)
class ABOScenes:
    """One product per scene; readers split the items from a seed, so there is one pool."""

    category: str
    film: Film
    seed: int
    bits: int
    styles: Mapping[str, int | float]

    @classmethod
    def from_config(cls, cfg: Mapping[str, Any]) -> "ABOScenes":
        """From `conf/make_scenes.yaml` with `scenes=abo`.

        Raises:
            ConfigError: a value is not possible.
        """
        scenes = cfg["scenes"]
        check_styles(scenes["styles"], tuple(STYLES), "products")
        check_splits(cfg["splits"], ("items",), "ABO's renders, which have one pool of items,")
        if cfg["splits"]["items"]["views"] > VIEWS:
            raise ConfigError(f"splits.items.views={cfg['splits']['items']['views']}: ABO has {VIEWS} directions")
        if scenes["bits"] not in (8, 16):
            raise ConfigError(f"scenes.bits={scenes['bits']}: expected 8 or 16")
        film = Film(cfg["resolution"], cfg["resolution"], FOV, cfg["samples_per_pixel"])
        return cls(scenes["category"], film, cfg["seed"], scenes["bits"], scenes["styles"])

    def parameters(self) -> dict[str, Any]:
        return {"bits": self.bits, "styles": dict(self.styles)}

    def split_folder(self, split: str) -> str:
        return "."

    def folder(self, job: SceneJob) -> Path:
        """The folder of an item."""
        return Path(job.root) / item_id(self.seed, job.index)

    def complete(self, job: SceneJob) -> bool:
        return self.folder(job).is_dir()

    def images(self, job: SceneJob) -> list[Path]:
        return sorted(self.folder(job).glob("*.png"))

    def finish(self, root: Path) -> None:
        """Folders say all there is."""

    def model(self, job: SceneJob) -> Model:
        """The product, in metres, standing somewhere near the origin."""
        rng = stream(self.seed, self.category, job, "shape")
        return build_product(rng, self.styles).moved((*rng.uniform(-0.4, 0.4, 2), 0.0))

    def poses(self, model: Model, views: int) -> Float[np.ndarray, "views 4 4"]:
        """cam2world of OpenCV, exactly as the file holds it in single precision."""
        low, high = model.bounds()
        centre, extent = (low + high) / 2, np.abs(high - low).max() / 2
        c2w = np.stack([look_at(centre + DISTANCE * extent * d, centre) for d in directions()[:views]])
        return (c2w @ OPENGL).astype(np.float32).astype(np.float64) @ OPENGL

    def make(self, job: SceneJob, renderer: MitsubaRenderer) -> None:
        model = self.model(job)
        c2w = self.poses(model, job.views)
        noise = int(stream(self.seed, self.category, job, "noise").integers(2**32))
        views = renderer.render(ModelWorld(model), c2w, noise)
        folder = self.folder(job)
        with half_written(job.root, folder) as partial:
            (partial / "depth").mkdir()
            for k in range(job.views):
                name = f"{folder.name}_{k:02d}"
                write_rgba(partial / f"{name}.png", rgba(views.radiance[k], views.alpha[k], self.bits), renderer.mi)
                np.savez_compressed(partial / "depth" / f"{name}.npz", depth=views.depth[k].astype(np.float32))
            (partial / "transforms.json").write_text(json.dumps(transforms(folder.name, c2w), indent=4))
            facts = {"category": self.category, "index": job.index, "seed": self.seed, "style": model.style}
            (partial / "scene.json").write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n")
            publish(partial, folder)


def transforms(item: str, c2w: Float[np.ndarray, "views 4 4"]) -> dict[str, Any]:
    """`transforms.json`, with paths of another machine as in the public files."""
    angle = float(np.float32(np.radians(FOV)))
    camera = {"angle_x": angle, "angle_y": angle, "shift_x": 0.0, "shift_y": 0.0}
    camera |= {"sensor_height": 36.0, "sensor_width": 36.0, "sensor_fit": "HORIZONTAL"}
    frames = [
        # The public script joins folder and name with a slash too many.
        {"file_path": f"/home/artist/renders/{item}//{item}_{k:02d}", "transform_matrix": pose.tolist()}
        | {"camera": camera}
        for k, pose in enumerate(c2w @ OPENGL)
    ]
    return {"obj_path": f"/{item}.glb", "frames": frames}


def write_rgba(path: Path, image: UInt[np.ndarray, "height width 4"], mi: Any) -> None:
    """An RGBA PNG of the image's own depth."""
    if image.dtype == np.uint8:
        Image.fromarray(image).save(path)
    else:  # Pillow has no 16-bit colour
        mi.Bitmap(image).write(str(path))
