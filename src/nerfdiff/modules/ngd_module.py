"""Test-time fine-tuning of one scene's field with the frozen CDM (paper, "Fine-tuning Phase")."""

import math

import torch
import torch.nn.functional as F
from lightning import LightningModule
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.distill.ray_batches import RayBatches
from nerfdiff.distill.refined_field import RefinedField
from nerfdiff.distill.teacher import Teacher
from nerfdiff.distill.trace import Step
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.errors import ConfigError
from nerfdiff.randomness import generator

DECAYS = {
    "none": lambda done: 1.0,
    "linear": lambda done: 1 - done,
    "cosine": lambda done: 0.5 * (1 + math.cos(math.pi * done)),
}
"""Factors of the learning rates, by the share of the teacher's steps that are done."""


class NGDModule(LightningModule):
    """At every step: ask the teacher for images of all views, then fit the field to them.

    The CDM and the encoder are no part of this module: what is saved, moved and counted is the field.

    Args:
        field: the single-image NeRF to start from.
        views: the virtual views.
        teacher: of the target images; `ngd`, `direct`, `sds` and `stochastic` differ in nothing else.
        inner_steps: N, Adam steps after each of the teacher's.
        rays: B, per inner step.
        lr_planes, lr_decoder: learning rates of W and θ.
        lr_decay: of both, over the teacher's steps: `none`, `linear` or `cosine`.
        fit_source: whether the input image, the one view that is known, is fitted beside the virtual views.
        source_tolerance: dB by which the input view may get worse before the scene falls back to its first field.
        seed: of the rays.

    Raises:
        ConfigError: another `lr_decay`, no rays, or negative steps.
    """

    def __init__(
        self,
        field: RefinedField,
        views: VirtualViews,
        teacher: Teacher,
        inner_steps: int,
        rays: int,
        lr_planes: float,
        lr_decoder: float,
        lr_decay: str,
        fit_source: bool,
        source_tolerance: float,
        seed: tuple[int | str, ...],
    ):
        super().__init__()
        self.automatic_optimization = False
        self.field = field
        self.views, self.teacher = views, teacher
        self.inner_steps, self.rays = inner_steps, rays
        if rays < 1 or inner_steps < 0:
            raise ConfigError(f"rays={rays} must be at least 1 and inner_steps={inner_steps} at least 0")
        if lr_decay not in DECAYS:
            raise ConfigError(f"strategy.lr_decay={lr_decay!r}: choose {', '.join(DECAYS)}")
        self.lr_planes, self.lr_decoder, self.lr_decay = lr_planes, lr_decoder, lr_decay
        self.fit_source, self.source_tolerance = fit_source, source_tolerance
        self.seed = seed
        self.trace: list[Step] = []
        self.status = "ok"

    def train_dataloader(self) -> range:
        """The teacher's steps."""
        return range(self.teacher.steps)

    def configure_optimizers(self) -> tuple[list, list]:
        optimizer = torch.optim.Adam(
            [
                {"params": [self.field.planes], "lr": self.lr_planes},
                {"params": self.field.decoder.parameters(), "lr": self.lr_decoder},
            ]
        )
        decay, steps = DECAYS[self.lr_decay], self.teacher.steps
        return [optimizer], [torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: decay(step / steps))]

    def on_train_start(self) -> None:
        self._start = self.field.snapshot()
        self._good = self._start
        self._generator = generator(self.device, *self.seed, "rays")

    def training_step(self, step: int, batch_idx: int) -> None:
        rendered = self._render(self.views.cameras) if self.teacher.follows_field else None
        targets = self.teacher.targets(step, rendered)
        losses = self._fit(targets)
        if self.inner_steps > 0:
            self.lr_schedulers().step()
        first, last = (float(losses[0]), float(losses[-1])) if len(losses) else (None, None)
        distance = first if rendered is None else float(F.mse_loss(rendered, targets))
        agreement = None if distance is None else -10 * math.log10(distance + 1e-6)
        self.trace.append(Step(self.teacher.t, self.teacher.weight, first, last, agreement))
        if bool(torch.isfinite(losses).all()) and self.field.is_finite():
            self._good, self._last_targets = self.field.snapshot(), targets
        else:
            self._fall_back("non-finite", self._good)

    def on_train_end(self) -> None:
        """Back to the field it began as, if it has been harmed.

        It has if it explains the last targets worse than the one it began as, or, as those may have followed it
        astray, the input view much worse.
        """
        if self.status != "ok" or self.inner_steps == 0:
            return
        refined = self._distances()
        after = self.field.snapshot()
        self.field.load_state_dict(self._start)
        began = self._distances()
        tolerated = 10 ** (self.source_tolerance / 10)
        if refined[0] <= began[0] and refined[1] <= tolerated * began[1] + 1e-6:
            self.field.load_state_dict(after)
        else:
            self._fall_back("diverged", self._start)

    def _fit(self, targets: Images) -> Tensor:
        """N inner steps; their losses."""
        optimizer, renderer = self.optimizers(), self.views.model.renderer
        cameras = self.views.cameras
        if self.fit_source:
            cameras = Cameras.join([cameras[0], self.field.cameras])[None]
            targets = torch.cat([targets, self.views.encoding.source])
        batches = RayBatches(cameras, self.field.near, self.field.far, targets, self._generator)
        losses = []
        for _ in range(self.inner_steps):
            rays, colours, jitter = batches.draw(self.rays, renderer.samples_per_ray)
            loss = F.mse_loss(renderer.render(self.field.field(), rays, jitter).rgb, colours)
            optimizer.zero_grad()
            self.manual_backward(loss)
            optimizer.step()
            losses.append(loss.detach())
        self.views.field_queries += renderer.samples_per_ray * self.inner_steps * self.rays
        return torch.stack(losses) if losses else targets.new_zeros(0)

    @torch.no_grad()
    def _render(self, cameras: Cameras) -> Images:
        renderer = self.views.model.renderer
        images = self.field.render(renderer, cameras).rgb[0].movedim(-1, 1)
        self.views.field_queries += renderer.samples_per_ray * images[:, 0].numel()
        return images

    def _distances(self) -> tuple[float, float]:
        """Mean squared errors of the last targets and of the input view."""
        source = self._render(self.field.cameras[None])
        return (
            float(F.mse_loss(self._render(self.views.cameras), self._last_targets)),
            float(F.mse_loss(source, self.views.encoding.source)),
        )

    def _fall_back(self, status: str, state: dict[str, Tensor]) -> None:
        self.field.load_state_dict(state)
        self.status = status
        self.trainer.should_stop = True
