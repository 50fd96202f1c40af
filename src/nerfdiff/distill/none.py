"""Strategy `none`: the single-image NeRF as it comes out of the encoder ("w/o NGD" in the paper's tables)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from lightning import Callback

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.field.kinds import TRIPLANE
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.model import NerfDiff
from nerfdiff.utils.timing import timed


@dataclass(frozen=True)
class SingleImageNeRF:
    """Encode once, render every view."""

    name: str

    @torch.no_grad()
    def predict(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        predicted = []
        for scene in scenes:
            encoding = model.encode(scene)
            if model.field_name == TRIPLANE:
                field = RefinedField(encoding.triplane, model.decoder)
                predicted.append(PredictedViews.of_field(SavedField(field, model.renderer), scene.target_cameras))
            else:  # nothing there that could be kept without the model
                with timed("render"):
                    rendering = model.render(encoding, scene.target_cameras)
                predicted.append(PredictedViews.of_rendering(rendering, model.renderer, scene.target_cameras))
        return predicted
