"""CLEVR scenes in the layout of Clevr3D (ObSuRF).

<root>/metadata.npz     camera_pos [scenes, 3, 3], shape [scenes, 10] (0 is an empty slot), …
<root>/images/img_<scene>_<v>.png      8-bit RGBA, opaque, v = 0, 1, 2; numbers are not zero-padded
<root>/depths/depths_<scene>_<v>.png   16 bits: distance from the camera · 65536 · 0.025, at most 40
<root>/masks/masks_<scene>_<v>.png     8-bit labels: 0 is the floor and what lies behind, objects from 1
<root>/.scenes/000000.json             the scene's facts, written last; `metadata.npz` is made of them
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from PIL import Image

from nerfdiff.poses import look_at_origin
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import settle
from procedural.clevr.metadata import SLOTS, facts_path, scene_facts, write_metadata
from procedural.clevr.objects import place_objects
from procedural.clevr.world import LAMPS, ClevrWorld
from procedural.colour import linear_to_srgb8
from procedural.kinds.kind import SceneJob, ascending, check_splits, stream
from procedural.mitsuba_renderer import Film, MitsubaRenderer
from procedural.root_folder import half_written

VIEWS = 3
PASSES = 4
# A 35 mm lens on a 32 mm sensor: 350 px at a width of 320.
FOCAL_PER_WIDTH = 35 / 32
DEPTH_CODES_PER_UNIT = 65536 * 0.025


@dataclass(frozen=True)
class Clevr3DScenes:
    """A few objects on a table, seen from three sides; readers split by number, so there is one pool.

    Args:
        objects: fewest and most of them.
        extent: their centres lie within ± this.
        gap: least distance between two.
        camera: where the first camera stands before `jitter` (± in each coordinate).
        distance: every view's distance is scaled by a factor from this interval.
        lamp_jitter: lamps stand ± this from their places, in each coordinate.
    """

    category: str
    film: Film
    seed: int
    objects: tuple[int, int]
    extent: float
    gap: float
    camera: tuple[float, float, float]
    jitter: float
    distance: tuple[float, float]
    lamp_jitter: float

    @classmethod
    def from_config(cls, cfg: Mapping[str, Any]) -> "Clevr3DScenes":
        """From `conf/make_scenes.yaml` with `scenes=clevr3d`.

        Raises:
            ConfigError: a value is not possible.
        """
        scenes, height = cfg["scenes"], cfg["resolution"]
        check_splits(cfg["splits"], ("scenes",), "Clevr3D, which has one pool of scenes,")
        if cfg["splits"]["scenes"]["views"] != VIEWS:
            raise ConfigError(f"splits.scenes.views={cfg['splits']['scenes']['views']}: Clevr3D has {VIEWS} views")
        if height % 3:
            raise ConfigError(f"resolution={height}: expected a multiple of 3, the width being 4/3 of it")
        objects = ascending("scenes.objects", scenes["objects"], 1, SLOTS)
        if not all(isinstance(count, int) for count in objects):
            raise ConfigError(f"scenes.objects={list(objects)}: expected whole numbers")
        distance = ascending("scenes.distance", scenes["distance"], 0.5, 2)
        for key in ("extent", "gap", "jitter", "lamp_jitter"):
            if not scenes[key] >= 0:
                raise ConfigError(f"scenes.{key}={scenes[key]}: expected at least 0")
        camera = tuple(scenes["camera"])
        if len(camera) != 3 or not all(isinstance(value, (int, float)) for value in camera):
            raise ConfigError(f"scenes.camera={list(camera)}: expected three numbers, x, y and z")
        x, y, z = camera
        # Rays at the top of the image still meet the floor: the background is floor, never nothing.
        lowest = np.arctan2(z - scenes["jitter"], np.hypot(x, y) + np.sqrt(2) * scenes["jitter"])
        if not lowest > np.arctan(0.375 / FOCAL_PER_WIDTH) + 0.02:
            raise ConfigError(
                f"scenes.camera={list(camera)} with scenes.jitter={scenes['jitter']} may see the horizon; "
                "raise the camera or lower the jitter"
            )
        if cfg["samples_per_pixel"] % PASSES:
            raise ConfigError(f"samples_per_pixel={cfg['samples_per_pixel']}: expected a multiple of {PASSES}")
        fov = float(np.degrees(2 * np.arctan(0.5 / FOCAL_PER_WIDTH)))
        film = Film(height, height * 4 // 3, fov, cfg["samples_per_pixel"], max_depth=4, passes=PASSES)
        settings = (scenes[key] for key in ("extent", "gap"))
        return cls(
            scenes["category"], film, cfg["seed"], objects, *settings, camera, scenes["jitter"], distance,
            scenes["lamp_jitter"],
        )  # fmt: skip

    def parameters(self) -> dict[str, Any]:
        keys = ("objects", "extent", "gap", "camera", "jitter", "distance", "lamp_jitter")
        return {key: getattr(self, key) for key in keys}

    def split_folder(self, split: str) -> str:
        return "."

    def complete(self, job: SceneJob) -> bool:
        return facts_path(job.root, job.index).exists()

    def images(self, job: SceneJob) -> list[Path]:
        return [Path(job.root) / "images" / f"img_{job.index}_{v}.png" for v in range(VIEWS)]

    def finish(self, root: Path) -> None:
        write_metadata(root)

    def world(self, job: SceneJob) -> ClevrWorld:
        """Objects and lamps."""
        rng = stream(self.seed, self.category, job, "shape")
        objects = place_objects(rng, self.objects, self.extent, self.gap)
        return ClevrWorld(objects, rng.uniform(-self.lamp_jitter, self.lamp_jitter, (len(LAMPS), 3)))

    def centres(self, job: SceneJob) -> Float[np.ndarray, "3 3"]:
        """Return the three cameras' centres: 120° apart about the vertical, each at its own distance."""
        rng = stream(self.seed, self.category, job, "cameras")
        x, y, z = np.array(self.camera) + rng.uniform(-self.jitter, self.jitter, 3)
        angles = np.arctan2(y, x) + np.arange(VIEWS) * 2 * np.pi / VIEWS
        across = np.hypot(x, y)
        ring = np.stack([across * np.cos(angles), across * np.sin(angles), np.full(VIEWS, z)], axis=1)
        return ring * rng.uniform(*self.distance, (VIEWS, 1))

    def make(self, job: SceneJob, renderer: MitsubaRenderer) -> None:
        world, centres = self.world(job), self.centres(job)
        c2w = np.stack([look_at_origin(centre) for centre in centres])
        noise = int(stream(self.seed, self.category, job, "noise").integers(2**32))
        views = renderer.render(world, c2w, noise)
        opaque = np.full((*views.mask.shape, 1), 255, np.uint8)
        pictures = {
            "images/img": np.concatenate([linear_to_srgb8(views.radiance), opaque], axis=-1),
            "depths/depths": encode_depth(views.depth, views.mask),
            "masks/masks": views.labels.astype(np.uint8),
        }
        facts = facts_path(job.root, job.index)
        with half_written(job.root, facts) as partial:
            targets = {}
            for name, images in pictures.items():
                for v, image in enumerate(images):
                    target = Path(job.root) / f"{name}_{job.index}_{v}.png"
                    targets[partial / target.name] = target
                    Image.fromarray(image).save(partial / target.name)
            targets[partial / facts.name] = facts
            (partial / facts.name).write_text(json.dumps(scene_facts(world.objects, centres)) + "\n")
            settle(partial)
            for source, target in targets.items():
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(source, target)


def encode_depth(
    depth: Float[np.ndarray, "views height width"], hit: np.ndarray
) -> UInt16[np.ndarray, "views height width"]:
    """z-depth as ObSuRF's codes of Euclidean distance; farther than 40, or nothing, is the largest code."""
    height, width = depth.shape[1:]
    v, u = np.mgrid[:height, :width] + 0.5
    slant = np.sqrt(1 + ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (FOCAL_PER_WIDTH * width) ** 2)
    codes = np.where(hit, depth * slant * DEPTH_CODES_PER_UNIT, np.inf)
    return np.minimum(np.round(codes), 65535).astype(np.uint16)
