"""Pictures while training: input, NeRF render, depth, CDM sample and truth of fixed held-out scenes."""

from pathlib import Path

import torch
from jaxtyping import Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.cdm import CDMSampling
from nerfdiff.model import NerfDiff
from nerfdiff.results.pictures import colour_depth, contact_sheet


class Previews(Callback):
    """Write one sheet at each validation, a row per held-out view, as PNG and to TensorBoard.

    Args:
        folder: of the PNGs, named by step.
        scenes: held-out scenes shown, the first of the validation set.
        sampler: how the CDM's views are sampled.
    """

    def __init__(self, folder: str, scenes: int, sampler: CDMSampling):
        self.folder = Path(folder)
        self.scenes = scenes
        self.sampler = sampler
        self._shown: list[dict[str, Tensor]] = []

    def on_validation_batch_end(
        self, trainer, pl_module, outputs, batch: ViewBatch, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        if trainer.is_global_zero and not trainer.sanity_checking and batch_idx < self.scenes:
            with trainer.precision_plugin.forward_context():
                self._shown.append(self._pictures(pl_module.model, batch, pl_module.hparams.seed))

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self._shown:
            return
        columns = {name: torch.cat([scene[name] for scene in self._shown]) for name in self._shown[0]}
        self._shown = []
        contact_sheet(self.folder / f"step_{trainer.global_step:07d}.png", columns)
        strips = torch.cat([images.movedim(0, 1).flatten(1, 2) for images in columns.values()], -1)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(f"held-out/{', '.join(columns)}", strips.clamp(0, 1), trainer.global_step)

    @torch.no_grad()
    def _pictures(
        self, model: NerfDiff, batch: ViewBatch, seed: int
    ) -> dict[str, Float[Tensor, "views 3 height width"]]:
        encoding = model.encode(batch)
        rendering = model.render(encoding, batch.target_cameras)
        near, far = float(batch.near[0]), float(batch.far[0])
        pictures = {
            "input": batch.source.expand_as(batch.targets[0]),
            "render": rendering.images[0],
            "depth": colour_depth(rendering.depth[0], near, far, rendering.opacity[0]),
            "cdm": self.sampler.sample(model, encoding, batch.target_cameras, (seed, "preview", *batch.scene_ids))[0],
            "truth": batch.targets[0],
        }
        return {name: images.float().cpu() for name, images in pictures.items()}
