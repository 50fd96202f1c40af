"""One scene to render, and all that is random about it."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.scenes.car_proportions import STYLES as CAR_STYLES
from nerfdiff.scenes.cars import build_car
from nerfdiff.scenes.chairs import STYLES as CHAIR_STYLES
from nerfdiff.scenes.chairs import build_chair
from nerfdiff.scenes.layout import scene_folder, write_scene
from nerfdiff.scenes.mesh import Model
from nerfdiff.scenes.mitsuba_renderer import MitsubaRenderer
from nerfdiff.scenes.poses import random_sphere, srn_spiral

BUILDERS = {"cars": build_car, "chairs": build_chair}
STYLES = {"cars": tuple(CAR_STYLES), "chairs": tuple(CHAIR_STYLES)}


@dataclass(frozen=True)
class SceneJob:
    """One scene to render.

    Everything random about it follows from (seed, category, split, index) alone, never from the process
    that happens to render it.
    """

    root: Path
    category: str
    split: str
    index: int
    views: int
    seed: int
    radius: int | float
    elevation: tuple[int | float, int | float]
    styles: Mapping[str, int | float]

    @property
    def folder(self) -> Path:
        return scene_folder(self.root, self.category, self.split, self.index)

    def rng(self, purpose: str) -> np.random.Generator:
        """Independent streams for shape, cameras and noise: more views do not change the object."""
        words = [zlib.crc32(word.encode()) for word in (self.category, self.split, purpose)]
        return np.random.default_rng([self.seed, self.index, *words])

    def model(self) -> Model:
        """The object."""
        return BUILDERS[self.category](self.rng("shape"), self.styles)

    def poses(self) -> Float[np.ndarray, "views 4 4"]:
        """Its cameras: random in training, SRN's spiral otherwise."""
        if self.split == "train":
            return random_sphere(self.radius, self.views, self.rng("cameras"), self.elevation)
        return srn_spiral(self.radius, self.views)

    def render(self, renderer: MitsubaRenderer) -> int:
        """Render and write the scene.

        Returns:
            The number of images written.

        Raises:
            DataError: the scene cannot be written.
        """
        model, c2w = self.model(), self.poses()
        views = renderer.render(model, c2w, int(self.rng("noise").integers(2**32)))
        facts = {"category": self.category, "split": self.split, "index": self.index, "seed": self.seed}
        write_scene(self.root, self.folder, views, c2w, {**facts, "style": model.style})
        return len(c2w)
