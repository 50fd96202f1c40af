"""Strategy `none`: the single-image NeRF as it comes out of the encoder ("w/o NGD" in the paper's tables)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from lightning import Callback

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.field_file import SavedField
from nerfdiff.distill.refined_field import RefinedField
from nerfdiff.distill.strategy import Views
from nerfdiff.metrics.depth import z_depth
from nerfdiff.model import NerfDiff


@dataclass(frozen=True)
class SingleImageNeRF:
    """Encode once, render every view."""

    name: str

    @torch.no_grad()
    def predict(self, model: NerfDiff, scene: ViewBatch, seed: int, callbacks: Sequence[Callback] = ()) -> Views:
        encoding = model.encode(scene.source, scene.source_cameras, scene.near, scene.far)
        rendering = model.render(encoding, scene.target_cameras)
        return Views(
            images=rendering.rgb[0].movedim(-1, 1),
            opacity=rendering.opacity[0],
            depth=z_depth(rendering.depth[0], scene.target_cameras[0]),
            field_queries=model.renderer.samples_per_ray * rendering.opacity.numel(),
            field=SavedField(RefinedField(encoding.triplane, model.decoder), model.renderer),
        )
