"""A field fine-tuned for one scene at test time, by any teacher, then rendered: strategies `ngd`, `direct`, `sds`."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from lightning import Callback, Trainer

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.field_file import SavedField
from nerfdiff.distill.priors.prior import Prior
from nerfdiff.distill.refined_field import RefinedField
from nerfdiff.distill.strategy import Views
from nerfdiff.distill.teacher import MakeTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.model import NerfDiff
from nerfdiff.modules.ngd_module import NGDModule

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
        source_tolerance: dB by which the input view may get worse before the scene falls back to its first field.
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
    source_tolerance: float
    views_at_once: int

    def predict(self, model: NerfDiff, scene: ViewBatch, seed: int, callbacks: Sequence[Callback] = ()) -> Views:
        module = self.distil(model, scene, seed, callbacks)
        return Views.of_field(
            SavedField(module.field, model.renderer),
            scene.target_cameras,
            module.views.denoiser_calls,
            module.views.field_queries,
            module.trace,
            module.status,
        )

    def distil(self, model: NerfDiff, scene: ViewBatch, seed: int, callbacks: Sequence[Callback] = ()) -> NGDModule:
        """The fine-tuned field of a batch of one scene, with its trace and status.

        Args:
            callbacks: of the Trainer that fits it.
        """
        purpose = (seed, "distil", *scene.scene_ids)
        with torch.no_grad():
            encoding = model.encode(scene.source, scene.source_cameras, scene.near, scene.far)
        views = VirtualViews(model, encoding, self.prior(scene), self.views_at_once, purpose)
        module = NGDModule(
            RefinedField(encoding.triplane, model.decoder),
            views,
            self.teacher(views),
            self.inner_steps,
            self.rays,
            self.lr_planes,
            self.lr_decoder,
            self.lr_decay,
            self.fit_source,
            self.source_tolerance,
            purpose,
        )
        device = scene.source.device
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
        if module.status != "ok":
            log.warning("%s of scene %s fell back: %s", self.name, scene.scene_ids[0], module.status)
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
