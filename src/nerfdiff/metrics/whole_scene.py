"""Measures of a scene as a whole, in the space of its input camera: floaters, flatness, agreement of views."""

from dataclasses import dataclass
from pathlib import Path

import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.fit.saved_field import load_field
from nerfdiff.metrics.consistency import Consistency, evenly
from nerfdiff.metrics.geometry import depth_extent, floaters
from nerfdiff.metrics.predictions import Prediction
from nerfdiff.utils.randomness import generator


@dataclass(frozen=True)
class Geometry:
    """Measures floaters and depth extent.

    Args:
        floater_views: true views that carve the hull and that rays are drawn from, at most, evenly spread.
        floater_rays, invisible: see `geometry.floaters`.
        hull_margin: pixels that true silhouettes are widened by.
        depth_tails: share of surface points left out at either end of the depth extent.
        seed: of the rays.
    """

    floater_views: int
    floater_rays: int
    hull_margin: int
    invisible: float
    depth_tails: float
    seed: int


@dataclass(frozen=True)
class WholeScene:
    """All metrics of a whole scene.

    Args:
        opacity_threshold: above it a pixel sees a surface.
    """

    geometry: Geometry
    consistency: Consistency
    opacity_threshold: float

    def measure(
        self,
        number: int,
        prediction: Prediction,
        scene: Scene,
        source: Scene,
        field: Path,
        device: torch.device,
    ) -> dict[str, float | None]:
        """The metrics of whole scenes in `table.METRICS`; None or missing where they cannot be measured.

        Args:
            number: of the scene among those predicted.
            scene: true, of the same views as predicted.
            source: true, of the input view alone.
            field: file of the scene's field, which need not be there.

        Raises:
            DataError: the field's file is damaged.
        """
        cameras = scene.cameras.relative_to(source.cameras)
        return {
            **self._geometry(prediction, scene, cameras, field, device),
            **self._consistency(number, prediction, scene, cameras, source.cameras, device),
        }

    def _geometry(
        self, prediction: Prediction, scene: Scene, cameras: Cameras, field: Path, device: torch.device
    ) -> dict[str, float | None]:
        settings = self.geometry
        values: dict[str, float | None] = {}
        if prediction.depth is not None and prediction.opacity is not None and scene.depth is not None:
            values["depth_extent"] = depth_extent(
                prediction.depth, prediction.opacity, scene.depth, cameras, self.opacity_threshold, settings.depth_tails
            )
        # Depth, where there is one, also knows of what is no object but no background either, such as a floor.
        silhouettes = scene.depth > 0 if scene.depth is not None else scene.mask
        if silhouettes is not None and field.exists():
            saved = load_field(field)
            views = evenly(len(silhouettes), settings.floater_views)
            if saved.renderer.background is not None:
                values["floaters"] = floaters(
                    saved.field.to(device).field(),
                    saved.renderer,
                    cameras[views].to(device),
                    silhouettes[views].to(device),
                    scene.near,
                    scene.far,
                    settings.floater_rays,
                    settings.hull_margin,
                    settings.invisible,
                    generator(device, settings.seed, "floaters", scene.id),
                )
        return values

    def _consistency(
        self,
        number: int,
        prediction: Prediction,
        scene: Scene,
        cameras: Cameras,
        source: Cameras,
        device: torch.device,
    ) -> dict[str, float | None]:
        if not self.consistency.measures(number):
            return {}
        around = scene.id, cameras.to(device), source.to(device), scene.near, scene.far
        return {
            "consistency_psnr": self.consistency.measure(prediction.pixels.to(device), *around),
            "consistency_psnr_truth": self.consistency.measure_truth(scene.pixels.to(device), *around),
        }
