"""Test-time fine-tuning of one scene's field with the frozen CDM (paper, "Fine-tuning Phase")."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from lightning import LightningModule
from torch import Tensor

from nerfdiff.distill.ray_batches import RayBatches
from nerfdiff.distill.refined_field import RefinedField
from nerfdiff.distill.teacher import Teacher
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.randomness import generator


@dataclass(frozen=True)
class Step:
    """One line of the trace.

    Args:
        loss: mean squared error of the inner steps' rays, first and last.
        weight: of guidance, where there is any.
        agreement: PSNR of the field's renderings against the targets before they were fitted.
    """

    loss: tuple[float, float] | None
    weight: float | None
    agreement: float


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
        seed: of the rays.
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
        seed: tuple[int | str, ...],
    ):
        super().__init__()
        self.automatic_optimization = False
        self.field = field
        self.views, self.teacher = views, teacher
        self.inner_steps, self.rays = inner_steps, rays
        self.lr_planes, self.lr_decoder = lr_planes, lr_decoder
        self.seed = seed
        self.trace: list[Step] = []
        self.status = "ok"

    def train_dataloader(self) -> range:
        """The teacher's steps."""
        return range(self.teacher.steps)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(
            [
                {"params": [self.field.planes], "lr": self.lr_planes},
                {"params": self.field.decoder.parameters(), "lr": self.lr_decoder},
            ]
        )

    def on_train_start(self) -> None:
        self._start = self.field.snapshot()
        self._good = self._start
        self._generator = generator(self.device, *self.seed, "rays")

    def training_step(self, step: int, batch_idx: int) -> None:
        rendered = self._renderings()
        targets = self.teacher.targets(step, rendered)
        losses = self._fit(targets)
        agreement = -10 * torch.log10(F.mse_loss(rendered, targets) + 1e-6)
        ends = (float(losses[0]), float(losses[-1])) if len(losses) else None
        self.trace.append(Step(ends, self.teacher.weight, float(agreement)))
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
        batches = RayBatches(self.views.cameras, self.field.near, self.field.far, targets, self._generator)
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
