"""Fine-tune scenes' fields at test time, by any teacher, then render them: strategies `ngd`, `direct`, `sds`, …"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from lightning import Callback, Trainer

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.course import DEADLINE, Deadline, Pace, Timekeeper
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.priors import Prior
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.distill.teacher import MakeTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.objective import Objective
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.fit.settings import FitSettings
from nerfdiff.model import NerfDiff
from nerfdiff.utils.config import from_keys
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)


@from_keys(fit=FitSettings, objective=Objective, deadline=Deadline)
@dataclass(frozen=True)
class Distillation:
    """Encode once, fit the field to the teacher's images of the virtual views, render.

    Args:
        prior: Π, the virtual views' cameras.
        teacher: makes the teacher of a scene from its virtual views.
        views_at_once: views denoised in one batch, which bounds memory.
        objective: what the field is fitted for.
        deadline: by which the field has to be there; less is computed where time is short.
        pace: of this strategy here, as far as it was measured.
    """

    name: str
    prior: Prior
    teacher: MakeTeacher
    fit: FitSettings
    views_at_once: int
    objective: Objective = field(default_factory=Objective)
    deadline: Deadline = field(default_factory=Deadline)
    pace: Pace = field(default_factory=Pace, compare=False)

    def predict(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        """See `Strategy`."""
        module = self.distil(model, scenes, seed, callbacks)
        predicted = []
        for number, (scene, virtual) in enumerate(zip(scenes, module.views, strict=True)):
            saved = SavedField(module.field.alone(number), model.renderer)
            made = virtual.denoiser_calls, virtual.field_queries, module.trace(number), module.statuses[number]
            views = PredictedViews.of_field(saved, scene.target_cameras, *made)
            course = module.course
            did = {"steps": course.taken, "steps_planned": course.planned, "stopped_by": course.stopped_by}
            predicted.append(replace(views, virtual_views=len(virtual), **did))
        return predicted

    def distil(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> NGDModule:
        """Fine-tune the fields of scenes together.

        Args:
            scenes: batches of one, with images of one size.
            callbacks: of the Trainer that fits them.

        Returns:
            the fields, with their traces and statuses.

        Raises:
            ConfigError: scenes that do not fit into one batch, or a field that is no triplane.
        """
        if len({scene.source.shape for scene in scenes}) > 1:
            raise ConfigError("scenes whose images differ in size cannot be distilled together: set scenes_at_once=1")
        begin = partial(self.deadline.begin, self.pace, len(scenes), scenes[0].source.device)
        keeper = begin()
        if keeper is not None and not self.pace.steps:
            self._distil(model, scenes, seed, (), begin(True))
        return self._distil(model, scenes, seed, callbacks, keeper)

    def _distil(
        self,
        model: NerfDiff,
        scenes: Sequence[ViewBatch],
        seed: int,
        callbacks: Sequence[Callback],
        keeper: Timekeeper | None,
    ) -> NGDModule:
        # encode, one by one, so that a scene's numbers do not depend on the others
        seeds = [(seed, "distil", *scene.scene_ids) for scene in scenes]
        with torch.no_grad():
            encodings = [model.encode(scene) for scene in scenes]
        triplane = Triplane.join([encoding.triplane for encoding in encodings])
        # place the virtual views
        cameras, fit = [self.prior(scene) for scene in scenes], self.fit
        if keeper is not None:
            count, inner_steps = keeper.plan(cameras[0].shape[1], fit.inner_steps)
            cameras, fit = [of[:, spread(of.shape[1], count)] for of in cameras], replace(fit, inner_steps=inner_steps)
        with nullcontext() if keeper is None else keeper.measure("begin", cameras[0].shape[1]):
            views = [
                VirtualViews(model, encoding, of, self.views_at_once, own, self.fit.views_last)
                for encoding, of, own in zip(encodings, cameras, seeds, strict=True)
            ]
            teachers = [self.teacher(v) for v in views]
        # fit the field to the teachers' images
        module = NGDModule(RefinedField(triplane, model.decoder), views, teachers, fit, seeds, self.objective, keeper)
        if keeper is not None and keeper.shortened:
            module.course.stopped_by = DEADLINE
        self.pace.steps = module.steps
        device = scenes[0].source.device
        with torch.enable_grad(), _quiet("lightning.pytorch"):
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
def _quiet(name: str) -> Iterator[None]:
    """Silence a logger's messages below warnings: Lightning repeats the same for every scene's Trainer."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
