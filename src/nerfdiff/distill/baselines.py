"""Two baselines without 3D: the input image and the mean image, as every view."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.scene import SceneReader
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.model import NerfDiff
from nerfdiff.utils.randomness import generator


@dataclass(frozen=True)
class CopyInput:
    """Predict the input image for every view."""

    name: str = "copy_input"

    def predict(
        self, model: NerfDiff | None, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        return [PredictedViews(scene.source.expand(scene.targets.shape[1], -1, -1, -1)) for scene in scenes]


@dataclass(frozen=True)
class MeanImage:
    """Predict the mean of the training images for every view."""

    mean: Float[Tensor, "3 height width"]
    name: str = "mean_image"

    def predict(
        self, model: NerfDiff | None, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        def views(scene: ViewBatch) -> PredictedViews:
            mean = F.interpolate(self.mean[None], scene.targets.shape[-2:], mode="area")
            return PredictedViews(mean.expand(scene.targets.shape[1], -1, -1, -1).to(scene.source))

        return [views(scene) for scene in scenes]


def mean_training_image(reader: SceneReader, scenes: int, seed: int) -> Float[Tensor, "3 height width"]:
    """Return the mean over all views of up to `scenes` training scenes, chosen by `seed`."""
    order = torch.randperm(len(reader), generator=generator("cpu", seed, "mean image"))
    means = [reader.load(int(index)).images.mean(0) for index in order[:scenes]]
    return torch.stack(means).mean(0)


def mean_image(data: SceneDataModule, scenes: int, seed: int, name: str) -> MeanImage:
    """Return the baseline of a dataset's training images, see `mean_training_image`."""
    return MeanImage(mean_training_image(data.reader("train"), scenes, seed), name)
