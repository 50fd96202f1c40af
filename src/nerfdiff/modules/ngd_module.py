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
        seed: of the rays.

    Raises:
        ConfigError: another `lr_decay`.
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
        seed: tuple[int | str, ...],
    ):
        super().__init__()
        self.automatic_optimization = False
        self.field = field
        self.views, self.teacher = views, teacher
        self.inner_steps, self.rays = inner_steps, rays
        if lr_decay not in DECAYS:
            raise ConfigError(f"strategy.lr_decay={lr_decay!r}: choose {', '.join(DECAYS)}")
        self.lr_planes, self.lr_decoder, self.lr_decay = lr_planes, lr_decoder, lr_decay
        self.fit_source = fit_source
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
        rendered = self._renderings()
        targets = self.teacher.targets(step, rendered)
        losses = self._fit(targets)
        self.lr_schedulers().step()
        agreement = -10 * torch.log10(F.mse_loss(rendered, targets) + 1e-6)
        first, last = (float(losses[0]), float(losses[-1])) if len(losses) else (None, None)
        self.trace.append(Step(self.teacher.t, self.teacher.weight, first, last, float(agreement)))
        if bool(torch.isfinite(losses).all()) and self.field.is_finite():
            self._good, self._last_targets = self.field.snapshot(), targets
        else:
            self._fall_back("non-finite", self._good)

    def on_train_end(self) -> None:
        """A field that explains the last targets worse than the one it began as has been harmed: back to that one."""
        if self.status != "ok" or self.inner_steps == 0:
            return
        refined = self._distance()
        after = self.field.snapshot()
        self.field.load_state_dict(self._start)
        if not refined <= self._distance():
            self._fall_back("diverged", self._start)
        else:
            self.field.load_state_dict(after)

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
        return torch.stack(losses) if losses else targets.new_zeros(0)

    @torch.no_grad()
    def _renderings(self) -> Images:
        return self.field.render(self.views.model.renderer, self.views.cameras).rgb[0].movedim(-1, 1)

    def _distance(self) -> float:
        return float(F.mse_loss(self._renderings(), self._last_targets))

    def _fall_back(self, status: str, state: dict[str, Tensor]) -> None:
        self.field.load_state_dict(state)
        self.status = status
        self.trainer.should_stop = True
