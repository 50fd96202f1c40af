"""Cars and chairs in the layout of SRN-ShapeNet, with depth and mask beside the colours.

    <root>/cars_train|cars_val|cars_test/<id>/
        intrinsics.txt  scene.json
        rgb/000000.png    8-bit RGB on white
        pose/000000.txt   cam2world, OpenCV axes
        depth/000000.npz  array `depth`, float32: distance along z in scene units, 0 where nothing was hit
        mask/000000.png   8-bit: 255 where the ray through the pixel's centre hits, else 0
    <root>/chairs_train/chairs_2.0_train/<id>/…    nested in training, as the public archive has it

A scene's folder appears under its name only when it is complete.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from nerfdiff.poses import SPIRAL_VIEWS, srn_spiral
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import publish
from procedural.car_proportions import STYLES as CAR_STYLES
from procedural.cars import build_car
from procedural.chairs import STYLES as CHAIR_STYLES
from procedural.chairs import build_chair
from procedural.kinds.kind import SceneJob, ascending, check_splits, check_styles, stream
from procedural.mesh import Model
from procedural.mitsuba_model import ModelWorld
from procedural.mitsuba_renderer import Film, MitsubaRenderer
from procedural.poses import FOCAL_PER_PIXEL, random_sphere, rings
from procedural.root_folder import half_written

SPLITS = ("train", "val", "test")
BUILDERS = {"cars": build_car, "chairs": build_chair}
STYLES = {"cars": tuple(CAR_STYLES), "chairs": tuple(CHAIR_STYLES)}


@dataclass(frozen=True)
class SRNScenes:
    """One object per scene: random cameras in training, SRN's spiral otherwise, or rings of some elevations."""

    category: str
    film: Film
    seed: int
    radius: int | float
    elevation: tuple[int | float, int | float]
    styles: Mapping[str, int | float]
    rings: tuple[int | float, ...] = ()

    @classmethod
    def from_config(cls, cfg: Mapping[str, Any]) -> "SRNScenes":
        """From `conf/make_scenes.yaml` with `scenes=cars` or `scenes=chairs`.

        Raises:
            ConfigError: a value is not possible.
        """
        scenes = cfg["scenes"]
        check_styles(scenes["styles"], STYLES[scenes["category"]], scenes["category"])
        check_splits(cfg["splits"], SPLITS, scenes["category"])
        for split, wanted in cfg["splits"].items():
            if split != "train" and not scenes["rings"] and wanted["views"] > SPIRAL_VIEWS:
                raise ConfigError(f"splits.{split}.views={wanted['views']}: the spiral has {SPIRAL_VIEWS} views")
        if not scenes["radius"] > 0.5:
            raise ConfigError(f"scenes.radius={scenes['radius']}: expected more than 0.5, outside the object")
        if any(not -90 < elevation < 90 for elevation in scenes["rings"]):
            raise ConfigError(f"scenes.rings={scenes['rings']}: expected degrees between -90 and 90")
        low, high = ascending("scenes.elevation", scenes["elevation"], -90, 90)
        if low == high:
            raise ConfigError(f"scenes.elevation=[{low}, {high}]: expected two different degrees")
        fov = float(np.rad2deg(2 * np.arctan(0.5 / FOCAL_PER_PIXEL)))
        film = Film(cfg["resolution"], cfg["resolution"], fov, cfg["samples_per_pixel"])
        return cls(
            scenes["category"],
            film,
            cfg["seed"],
            scenes["radius"],
            (low, high),
            scenes["styles"],
            tuple(scenes["rings"]),
        )

    def parameters(self) -> dict[str, Any]:
        found = {"radius": self.radius, "elevation": list(self.elevation), "styles": dict(self.styles)}
        return found | ({"rings": list(self.rings)} if self.rings else {})

    def split_folder(self, split: str) -> str:
        if (self.category, split) == ("chairs", "train"):
            return "chairs_train/chairs_2.0_train"
        return f"{self.category}_{split}"

    def folder(self, job: SceneJob) -> Path:
        """The folder of a scene."""
        return Path(job.root) / self.split_folder(job.split) / f"{job.index:06d}"

    def complete(self, job: SceneJob) -> bool:
        return self.folder(job).is_dir()

    def images(self, job: SceneJob) -> list[Path]:
        return sorted((self.folder(job) / "rgb").glob("*.png"))

    def finish(self, root: Path) -> None:
        """Folders say all there is."""

    def model(self, job: SceneJob) -> Model:
        """The object."""
        return BUILDERS[self.category](stream(self.seed, self.category, job, "shape"), self.styles)

    def poses(self, job: SceneJob) -> Float[np.ndarray, "views 4 4"]:
        """Its cameras."""
        if job.split == "train":
            rng = stream(self.seed, self.category, job, "cameras")
            return random_sphere(self.radius, job.views, rng, self.elevation)
        return rings(self.radius, job.views, self.rings) if self.rings else srn_spiral(self.radius, job.views)

    def make(self, job: SceneJob, renderer: MitsubaRenderer) -> None:
        model, c2w = self.model(job), self.poses(job)
        noise = int(stream(self.seed, self.category, job, "noise").integers(2**32))
        views = renderer.render(ModelWorld(model), c2w, noise)
        facts = {"category": self.category, "split": job.split, "index": job.index, "seed": self.seed}
        facts["style"] = model.style
        folder = self.folder(job)
        with half_written(job.root, folder) as partial:
            for kind in ("rgb", "pose", "depth", "mask"):
                (partial / kind).mkdir()
            for k, pose in enumerate(c2w):
                Image.fromarray(views.rgb[k]).save(partial / "rgb" / f"{k:06d}.png")
                (partial / "pose" / f"{k:06d}.txt").write_text(pose_text(pose))
                np.savez_compressed(partial / "depth" / f"{k:06d}.npz", depth=views.depth[k].astype(np.float32))
                mask = views.mask[k].astype(np.uint8) * 255
                Image.fromarray(mask).save(partial / "mask" / f"{k:06d}.png")
            (partial / "intrinsics.txt").write_text(intrinsics_text(self.film.height))
            (partial / "scene.json").write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n")
            folder.parent.mkdir(parents=True, exist_ok=True)
            publish(partial, folder)


def intrinsics_text(resolution: int) -> str:
    """`intrinsics.txt` of SRN: f cx cy, two unused lines, height and width."""
    focal, centre = FOCAL_PER_PIXEL * resolution, resolution / 2
    return f"{focal:f} {centre:f} {centre:f} 0.\n0. 0. 0.\n1.\n{resolution} {resolution}\n"


def pose_text(c2w: Float[np.ndarray, "4 4"]) -> str:
    """A pose file: 16 numbers on one line, row by row."""
    return " ".join(repr(float(v)) for v in np.asarray(c2w, np.float64).ravel())
