"""Fields fine-tuned for scenes at test time, by any teacher, then rendered: strategies `ngd`, `direct`, `sds`."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from lightning import Callback, Trainer

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.priors import Prior
from nerfdiff.distill.strategy import Views
from nerfdiff.distill.teacher import MakeTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Distillation:
    """Encode once, fit the field to what the teacher makes of the virtual views, render.

    Args:
        prior: Π, the virtual views' cameras.
        teacher: of the images they should show.
        inner_steps: N.
        rays: B.
        lr_planes, lr_decoder: learning rates of W and θ.
        lr_decay: of both, as the steps go by: `none`, `linear` or `cosine`.
        fit_source: whether the input image is fitted beside the virtual views.
        target_tolerance, source_tolerance: dB by which the last targets and the input view may be explained worse
            before a scene falls back to its first field.
        coarse: where importance samples of the inner steps come from: new coarse weights at `every_step`, or those of
            the last `refresh`, when the field was rendered for the teacher.
        cuda_graphs: record an inner step once and replay it, on a GPU.
        views_at_once: views denoised in one batch, which bounds memory.
    """

    name: str
    prior: Prior
    teacher: MakeTeacher
    inner_steps: int
    rays: int
    lr_planes: float
    lr_decoder: float
    lr_decay: str
    fit_source: bool
    target_tolerance: float
    source_tolerance: float
    coarse: str
    cuda_graphs: bool
    views_at_once: int

    def predict(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[Views]:
        module = self.distil(model, scenes, seed, callbacks)
        predicted = []
        for number, (scene, virtual) in enumerate(zip(scenes, module.views, strict=True)):
            saved = SavedField(module.field.alone(number), model.renderer)
            made = virtual.denoiser_calls, virtual.field_queries, module.trace(number), module.statuses[number]
            predicted.append(replace(Views.of_field(saved, scene.target_cameras, *made), virtual_views=len(virtual)))
        return predicted

    def distil(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> NGDModule:
        """The fine-tuned fields of scenes, distilled together, with their traces and statuses.

        Args:
            scenes: batches of one, with images of one size.
            callbacks: of the Trainer that fits them.

        Raises:
            ConfigError: scenes that do not fit into one batch, or a field that is no triplane.
        """
        if len({scene.source.shape for scene in scenes}) > 1:
            raise ConfigError("scenes whose images differ in size cannot be distilled together: set scenes_at_once=1")
        seeds = [(seed, "distil", *scene.scene_ids) for scene in scenes]
        with torch.no_grad():
            # One by one, so that a scene's numbers do not depend on its company.
            encodings = [model.encode(scene) for scene in scenes]
        triplane = Triplane.join([encoding.triplane for encoding in encodings])
        views = [
            VirtualViews(model, encoding, self.prior(scene), self.views_at_once, own)
            for encoding, scene, own in zip(encodings, scenes, seeds, strict=True)
        ]
        module = NGDModule(
            RefinedField(triplane, model.decoder),
            views,
            [self.teacher(v) for v in views],
            self.inner_steps,
            self.rays,
            self.lr_planes,
            self.lr_decoder,
            self.lr_decay,
            self.fit_source,
            self.target_tolerance,
            self.source_tolerance,
            self.coarse,
            self.cuda_graphs,
            seeds,
        )
        device = scenes[0].source.device
        with torch.enable_grad(), _hushed("lightning.pytorch"):
            trainer = Trainer(
                max_epochs=1,
                accelerator="cuda" if device.type == "cuda" else "cpu",
                devices=[device.index or 0] if device.type == "cuda" else 1,
                logger=False,
                callbacks=list(callbacks),
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
            trainer.fit(module)
        module.to(device)
        for scene, status in zip(scenes, module.statuses, strict=True):
            if status != "ok":
                log.warning("%s of scene %s fell back: %s", self.name, scene.scene_ids[0], status)
        return module


@contextmanager
def _hushed(name: str) -> Iterator[None]:
    """Without what a logger says once per training run: there is one Trainer per scene."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
