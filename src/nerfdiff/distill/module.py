"""Test-time fine-tuning of scenes' fields with the frozen CDM (paper, "Fine-tuning Phase")."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.distill.teacher import Teacher
from nerfdiff.distill.trace import Step
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField, choose
from nerfdiff.metrics.image import psnr_of_mse
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.timing import timed

DECAYS = {
    "none": lambda done: 1.0,
    "linear": lambda done: 1 - done,
    "cosine": lambda done: 0.5 * (1 + math.cos(math.pi * done)),
}
"""Factors of the learning rates, by the share of the teacher's steps that are done."""

LOOKS = ("every_step", "refresh")
"""When coarse weights are found anew."""

SceneImages = Float[Tensor, "scenes views 3 height width"]


class NGDModule(LightningModule):
    """At every step: ask the teachers for images of all views, then fit the fields to them.

    The CDM and the encoder are no part of this module: what is saved, moved and counted is the fields. Scenes share
    nothing but the device's time: each has its own views, teacher, noise, parameters, loss and end.

    Args:
        field: the single-image NeRFs to start from, of one or several scenes.
        views: the virtual views of each scene, as many for all.
        teachers: of each scene's target images; `ngd`, `direct`, `sds` and `stochastic` differ in nothing else.
        inner_steps: N, Adam steps after each of the teacher's.
        rays: B, per inner step and scene.
        lr_planes, lr_decoder: learning rates of W and θ.
        lr_decay: of both, over the teacher's steps: `none`, `linear` or `cosine`.
        fit_source: whether the input image, the one view that is known, is fitted beside the virtual views.
        target_tolerance, source_tolerance: dB by which the last targets and the input view may be explained worse
            before a scene falls back to its first field.
        coarse: when the weights are found from which importance samples are drawn: at `every_step` of the inner ones,
            or at each `refresh`, when the field is rendered for the teacher anyway: inner steps then look at all their
            samples at once. These take 2 bytes for each bin of each ray of all views. Where teachers do not follow the
            field, nothing is rendered between inner steps, and weights are found at every step.
        cuda_graphs: record an inner step once and replay it, on a GPU.
        seeds: of each scene's rays.

    Raises:
        ConfigError: another `lr_decay` or `coarse`, no rays, negative steps, or scenes with different numbers of views.
    """

    def __init__(
        self,
        field: RefinedField,
        views: Sequence[VirtualViews],
        teachers: Sequence[Teacher],
        inner_steps: int,
        rays: int,
        lr_planes: float,
        lr_decoder: float,
        lr_decay: str,
        fit_source: bool,
        target_tolerance: float,
        source_tolerance: float,
        coarse: str,
        cuda_graphs: bool,
        seeds: Sequence[tuple[int | str, ...]],
    ):
        super().__init__()
        self.automatic_optimization = False
        self.field = field
        self.views, self.teachers = views, teachers
        self.inner_steps, self.rays = inner_steps, rays
        if rays < 1 or inner_steps < 0:
            raise ConfigError(f"rays={rays} must be at least 1 and inner_steps={inner_steps} at least 0")
        if lr_decay not in DECAYS:
            raise ConfigError(f"strategy.lr_decay={lr_decay!r}: choose {', '.join(DECAYS)}")
        if coarse not in LOOKS:
            raise ConfigError(f"strategy.coarse={coarse!r}: choose {', '.join(LOOKS)}")
        if len({len(v) for v in views}) > 1:
            raise ConfigError(
                f"scenes with {sorted({len(v) for v in views})} virtual views cannot be distilled together: "
                "set scenes_at_once=1"
            )
        self.lr_planes, self.lr_decoder, self.lr_decay = lr_planes, lr_decoder, lr_decay
        self.fit_source = fit_source
        self.tolerances = target_tolerance, source_tolerance
        self.keeps_coarse = coarse == "refresh" and teachers[0].follows_field and inner_steps > 0
        self.cuda_graphs = cuda_graphs
        self.seeds = seeds
        self.statuses = ["ok"] * len(field)
        self.cameras = Cameras.join([v.cameras for v in views])
        self._source = torch.cat([v.encoding.source for v in views])
        self._records: list[tuple[float | None, float | None, Tensor | None, Tensor | None, Tensor | None]] = []

    @property
    def steps(self) -> int:
        """How many times the teachers are asked."""
        return self.teachers[0].steps

    def train_dataloader(self) -> range:
        """The teachers' steps."""
        return range(self.steps)

    def configure_optimizers(self) -> tuple[list, list]:
        # The rates are tensors so that a recorded step reads what they are when it is replayed.
        rates = torch.tensor([self.lr_planes, self.lr_decoder], device=self.device)
        groups = [
            {"params": [self.field.planes], "lr": rates[0]},
            {"params": list(self.field.decoder.parameters()), "lr": rates[1]},
        ]
        optimizer = torch.optim.Adam(groups, fused=True, capturable=self.device.type == "cuda")
        decay, steps = DECAYS[self.lr_decay], self.steps
        return [optimizer], [torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: decay(step / steps))]

    def on_train_start(self) -> None:
        self._start = self.field.snapshot()
        self._good = self._start
        self._finite = torch.ones(len(self.field), dtype=torch.bool, device=self.device)
        self._finite_on_host = torch.ones(len(self.field), dtype=torch.bool, pin_memory=self.device.type == "cuda")
        self._fitted = self.cameras
        if self.fit_source:
            both = zip(self.cameras, self.field.cameras, strict=True)
            self._fitted = Cameras.stack([Cameras.join([views, source[None]]) for views, source in both])
        self._batches = RayBatches(self._fitted, self.field.near, self.field.far)
        self._inner = InnerSteps(
            self.field,
            self.views[0].model.renderer,
            self._batches,
            self.optimizers().optimizer,
            self.rays,
            [generator(self.device, *seed, "rays") for seed in self.seeds],
            self.cuda_graphs,
        )

    def on_train_batch_start(self, step: int, batch_idx: int) -> int | None:
        """Ends the run (-1) when every scene is lost."""
        self._alive = self._finite_on_host.tolist()
        return None if any(self._alive) else -1

    def training_step(self, step: int, batch_idx: int) -> None:
        with timed("guide"):
            rendered = self._guidance() if self.teachers[0].follows_field else None
        targets = torch.stack(
            [
                teacher.targets(step, None if rendered is None else rendered[scene])
                if self._alive[scene]
                else self._last_targets[scene]  # the teacher of a lost scene rests
                for scene, teacher in enumerate(self.teachers)
            ]
        )
        losses = self._fit(targets)
        first, last = (losses[0], losses[-1]) if len(losses) else (None, None)
        distance = first if rendered is None else _mse(rendered, targets)
        one = self.teachers[self._alive.index(True)]
        self._records.append((one.t, one.weight, first, last, distance))
        self._keep_what_is_good(losses, targets)

    def on_train_end(self) -> None:
        """Back to the last finite field, or if it has been harmed to the one it began as.

        It has been if it explains the last targets worse than the one it began as (not by little: they may want what
        a blurred field gives up), or, as they may have followed it astray, the input view much worse. What was finite
        before it failed is no exception.
        """
        self.field.restore(self._good, ~self._finite)
        harmed = torch.zeros_like(self._finite)
        if self.inner_steps > 0:
            refined, after = self._distances(), self.field.snapshot()
            self.field.restore(self._start, ~harmed)
            began = self._distances()
            of_targets, of_source = (
                10 ** (dB / 10) * was + 1e-6 for dB, was in zip(self.tolerances, began, strict=True)
            )
            harmed = ~((refined[0] <= of_targets) & (refined[1] <= of_source))
            self.field.restore(after, ~harmed)
        for scene, (finite, worse) in enumerate(zip(self._finite.tolist(), harmed.tolist(), strict=True)):
            self.statuses[scene] = "non-finite" if not finite else "diverged" if worse else "ok"
        del self._inner, self._batches  # module and Trainer hold each other; what they need most of must not wait

    def trace(self, scene: int) -> list[Step]:
        """What happened, step by step. Waits for the device."""

        def number(values: Tensor | None) -> float | None:
            return None if values is None else float(values[scene])

        return [
            Step(t, weight, number(first), number(last), number(None if distance is None else psnr_of_mse(distance)))
            for t, weight, first, last, distance in self._records
        ]

    def progress(self) -> tuple[float | None, float | None]:
        """t of the last step and the mean agreement of renderings and targets, in dB. Waits for the device."""
        t, *_, distance = self._records[-1]
        return t, None if distance is None else float(psnr_of_mse(distance.nanmean()))

    @timed("fit")
    def _fit(self, targets: SceneImages) -> Float[Tensor, "steps scenes"]:
        """N inner steps; their losses."""
        if self.inner_steps == 0:
            return targets.new_zeros(0, len(targets))
        self._batches.paint(torch.cat([targets, self._source[:, None]], 1) if self.fit_source else targets)
        losses = self._inner.run(self.inner_steps)
        self.lr_schedulers().step()
        for views in self.views:
            views.field_queries += self.inner_steps * self._inner.queries
        return losses

    def _keep_what_is_good(self, losses: Float[Tensor, "steps scenes"], targets: SceneImages) -> None:
        """Note which scenes are well, on the device: nobody waits to hear it. One that is not stays lost."""
        self._finite &= torch.isfinite(losses).all(0) & self.field.finite() & torch.isfinite(targets).flatten(1).all(1)
        self._finite_on_host.copy_(
            self._finite, non_blocking=True
        )  # read without waiting: on a GPU it may be a step old
        if self._good is self._start:
            self._last_targets = targets
        keep = self._finite.reshape(-1, 1, 1, 1, 1)
        self._last_targets = torch.where(keep, targets, self._last_targets)
        self._good = choose(self._finite, self.field.snapshot(), self._good)

    def _guidance(self) -> SceneImages:
        """The virtual views' renderings. Where coarse weights are kept, the input view is looked at too if fitted."""
        if not self.keeps_coarse:
            return self._render(self.cameras)
        return self._render(self._fitted, remember=True)[:, : self.cameras.shape[1]]

    @torch.no_grad()
    def _render(self, cameras: Cameras, remember: bool = False) -> SceneImages:
        renderer = self.views[0].model.renderer
        rendering = self.field.render(renderer, cameras, keep_coarse=remember)
        if rendering.coarse is not None:
            self._batches.remember(rendering.coarse)
        images = rendering.images
        for views in self.views:
            views.field_queries += renderer.samples_per_ray * images[0, :, 0].numel()
        return images

    def _distances(self) -> tuple[Float[Tensor, "scenes"], Float[Tensor, "scenes"]]:
        """Mean squared errors of the last targets and of the input view."""
        source = self._render(self.field.cameras[:, None])
        return _mse(self._render(self.cameras), self._last_targets), _mse(source[:, 0], self._source)


def _mse(images: Float[Tensor, "scenes *rest"], others: Float[Tensor, "scenes *rest"]) -> Float[Tensor, "scenes"]:
    return (images - others).square().flatten(1).mean(1)
