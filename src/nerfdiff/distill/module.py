"""Test-time fine-tuning of scenes' fields with the frozen CDM (paper, "Fine-tuning Phase")."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.distill.course import Course, Plateau, Timekeeper
from nerfdiff.distill.teacher import Teacher
from nerfdiff.distill.trace import Step
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.objective import FitLoss, Objective
from nerfdiff.fit.ray_batches import RayBatches, with_views
from nerfdiff.fit.refined_field import RefinedField, choose
from nerfdiff.fit.settings import DECAYS, FitSettings
from nerfdiff.fit.weight_average import WeightAverage
from nerfdiff.metrics.image import psnr_of_mse
from nerfdiff.render.renderer import RenderedViews, Renderer
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.timing import timed

SceneImages = Float[Tensor, "scenes views 3 height width"]


class NGDModule(LightningModule):
    """Fit fields to their teachers' images of all views, step by step.

    The CDM and the encoder are no part of this module: what is saved, moved and counted is the fields. Scenes share
    nothing but the device's time: each has its own views, teacher, noise, parameters, loss and status.

    Args:
        field: the single-image NeRFs to start from, of one or several scenes.
        views: the virtual views of each scene, as many for all.
        teachers: of each scene's target images; `ngd`, `direct`, `sds` and `stochastic` differ in nothing else.
        fit: the inner steps' settings.
        seeds: of each scene's rays.
        objective: what the fields are fitted for, the paper's where it is not given.
        keeper: shortens what there is no time for; None: there is no deadline.

    Raises:
        ConfigError: scenes with different numbers of views, or settings that contradict each other.
    """

    def __init__(
        self,
        field: RefinedField,
        views: Sequence[VirtualViews],
        teachers: Sequence[Teacher],
        fit: FitSettings,
        seeds: Sequence[tuple[int | str, ...]],
        objective: Objective | None = None,
        keeper: Timekeeper | None = None,
    ):
        super().__init__()
        self.automatic_optimization = False
        self.field = field
        self.views, self.teachers, self.settings, self.seeds = views, teachers, fit, seeds
        self.objective = objective or Objective()
        steps = teachers[0].steps
        self.course, self._keeper = Course(steps, math.ceil(fit.steps_share * steps)), keeper
        if len({len(v) for v in views}) > 1:
            raise ConfigError(
                f"scenes with {sorted({len(v) for v in views})} virtual views cannot be distilled together: "
                "set scenes_at_once=1"
            )
        self.keeps_coarse = fit.coarse == "refresh" and teachers[0].follows_field and fit.inner_steps > 0
        kept, bins = fit.guidance(self._renderer).uniform_samples, self._renderer.uniform_samples
        if self.keeps_coarse and bins % kept:
            raise ConfigError(
                f"strategy.coarse=refresh: weights of strategy.guidance_uniform_samples={kept} bins cannot be split "
                f"into the model's {bins} evenly: choose a divisor of {bins}, or strategy.coarse=every_step"
            )
        self._split = bins // kept
        if fit.error_rays > 0 and self.objective.patch > 1:
            raise ConfigError(
                f"strategy.error_rays={fit.error_rays} draws single rays: set strategy.patch=1, or it to 0"
            )
        if fit.patience is not None and len(field) > 1:
            raise ConfigError(
                f"strategy.patience={fit.patience} lets each scene end when it has enough: set scenes_at_once=1"
            )
        self._plateau = None if fit.patience is None else Plateau(fit.patience, fit.rise)
        self.statuses = ["ok"] * len(field)
        self.cameras = Cameras.join([v.cameras for v in views])
        self._source = torch.cat([v.encoding.source for v in views])
        self._records: list[tuple[float | None, float | None, Tensor | None, Tensor | None, Tensor | None]] = []

    @property
    def steps(self) -> int:
        """Length of the schedule: the number of times the teachers are asked for targets, where time is not short."""
        return self.course.steps

    def train_dataloader(self) -> range:
        """Return the teachers' steps."""
        return range(self.steps)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        parameters = [self.field.planes], list(self.field.decoder.parameters())
        groups = [{"params": own, "lr": torch.zeros((), device=self.device)} for own in parameters]
        return torch.optim.Adam(groups, fused=True, capturable=self.device.type == "cuda")

    def on_train_start(self) -> None:
        self._start = self.field.snapshot()
        self._good = self._start
        # the field as it begins is rendered already, unless it is rendered otherwise here
        self._first = torch.stack([views.first_renderings for views in self.views])
        same = self.settings.guidance(self._renderer) == self._renderer and not self.keeps_coarse
        self._rendered: SceneImages | None = self._first if same else None
        self._first_source = self._render_source()
        self._seen: tuple[SceneImages, Tensor] | None = None
        self._seen_times = 0
        self._finite = torch.ones(len(self.field), dtype=torch.bool, device=self.device)
        self._finite_on_host = torch.ones(len(self.field), dtype=torch.bool, pin_memory=self.device.type == "cuda")
        self._fitted = self.cameras
        if self.settings.fit_source:
            both = zip(self.cameras, self.field.cameras, strict=True)
            self._fitted = Cameras.stack([Cameras.join([views, source[None]]) for views, source in both])
        self._batches = RayBatches(self._fitted, self.field.near, self.field.far)
        self._average = WeightAverage(self.field) if self.settings.average > 0 else None
        self._inner = InnerSteps(
            self.field,
            self._renderer,
            self._batches,
            self.optimizers().optimizer,
            max(1, round(self.settings.rays_share * self.settings.rays)),
            [generator(self.device, *seed, "rays") for seed in self.seeds],
            self.settings.cuda_graphs,
            FitLoss(self.objective, self.device),
            self._average,
        )

    def on_train_batch_start(self, step: int, batch_idx: int) -> int | None:
        """End the run (-1) when every scene's parameters are non-finite, or at the end of the course."""
        self._alive = self._finite_on_host.tolist()
        work = self.cameras.shape[1], self.settings.inner_steps
        affordable = None if self._keeper is None else self._keeper.affordable(self.course.taken, *work)
        return None if any(self._alive) and self.course.begin_step(affordable) else -1

    def training_step(self, step: int, batch_idx: int) -> None:
        place = self.course.position
        self._choose_views(place)
        with self._measured("ask", self.cameras.shape[1]):
            # render the field, for the teachers to guide by
            with timed("guide"):
                rendered = self._render_guidance() if self.teachers[0].follows_field else None
            # ask the teachers for targets: the guided, denoised images
            made = [
                teacher.targets(place, None if rendered is None else rendered[scene])
                if self._alive[scene]
                else self._last_targets[scene]  # a scene that failed asks its teacher no more
                for scene, teacher in enumerate(self.teachers)
            ]
        stays = any(images is None for images in made)  # for all scenes alike
        targets = rendered if stays else torch.stack(made)
        # fit the field to them
        self._set_rates(DECAYS[self.settings.lr_decay](place / self.steps))
        if stays:
            losses = targets.new_zeros(0, len(targets))
        else:
            self._weigh(rendered, targets)
            with self._measured("fit", self.settings.inner_steps):
                losses = self._fit(targets)
        # record, and keep the last finite field
        first, last = (losses[0], losses[-1]) if len(losses) else (None, None)
        distance = first if rendered is None else _mse(self._chosen_of(rendered), self._chosen_of(targets))
        one = self.teachers[self._alive.index(True)]
        self._records.append((one.t, one.weight, first, last, distance))
        self._keep_finite(losses, targets)
        self.course.end_step(self._is_enough(one))

    def on_train_end(self) -> None:
        """Restore each scene's last finite field, or, where the fit made it worse, the field it began as.

        Where weights are averaged, the mean takes the place of a finite scene's last field first.

        It is worse if it explains the last targets worse than the first field by more than `target_tolerance` (a little
        is allowed: the targets may have details that a blurred field gives up), or, as the targets may have followed
        the field astray, the input view by more than `source_tolerance`. This holds for a last finite field too.
        """
        self.field.restore(self._good, ~self._finite)
        if self._average is not None and self._average.started:
            self.field.restore(self._average.snapshot(), self._finite)
        worse = torch.zeros_like(self._finite)
        if self.settings.inner_steps > 0 and self.course.taken > 0:
            with self._measured("end", self.cameras.shape[1]):
                views = self._render(self._chosen_of(self.cameras), self._renderer).images
                source = self._render_source()
            first, targets = self._chosen_of(self._first), self._chosen_of(self._last_targets)
            for dB, now, before, truth in (
                (self.settings.target_tolerance, views, first, targets),
                (self.settings.source_tolerance, source, self._first_source, self._source),
            ):
                worse |= ~(_mse(now, truth) <= 10 ** (dB / 10) * _mse(before, truth) + 1e-6)
            self.field.restore(self._start, worse)
        for scene, (finite, diverged) in enumerate(zip(self._finite.tolist(), worse.tolist(), strict=True)):
            self.statuses[scene] = "non-finite" if not finite else "diverged" if diverged else "ok"
        # module and Trainer hold each other: free the largest tensors now
        del self._inner, self._batches, self._rendered, self._first, self._first_source, self._seen

    def trace(self, scene: int) -> list[Step]:
        """Return one scene's record, step by step. Waits for the device."""

        def number(values: Tensor | None) -> float | None:
            return None if values is None else float(values[scene])

        return [
            Step(t, weight, number(first), number(last), number(None if distance is None else psnr_of_mse(distance)))
            for t, weight, first, last, distance in self._records
        ]

    def progress(self) -> tuple[float | None, float | None]:
        """Return t of the last step and the mean PSNR of renderings against targets, in dB. Waits for the device."""
        t, *_, distance = self._records[-1]
        return t, None if distance is None else float(psnr_of_mse(distance.nanmean()))

    def _is_enough(self, teacher: Teacher) -> bool:
        """Return true if the field's renderings agree no better with the denoised images. Waits for the device."""
        if self._plateau is None or teacher.gap is None:
            return False
        return self._plateau(float(psnr_of_mse(teacher.gap)))

    def _measured(self, piece: str, count: int) -> AbstractContextManager:
        return nullcontext() if self._keeper is None else self._keeper.measure(piece, count)

    def _choose_views(self, place: float) -> None:
        """Choose the views of a step, for denoising and fitting alike, and begin to average where it is time."""
        for views in self.views:
            views.choose(place, self.steps)
            views.until = self.course.until
        chosen = [views.chosen for views in self.views]
        self._chosen = None if chosen[0] is None else torch.stack(chosen)
        if self._chosen is not None:
            begun = place == 0 and self._rendered is not None
            self._rendered = self._of_all_views(self._chosen_of(self._rendered)) if begun else None  # of other views
        fitted = self._chosen
        if fitted is not None and self.settings.fit_source:  # it comes after the virtual views
            source = torch.full_like(fitted[:, :1], self.cameras.shape[1])
            fitted = torch.cat([fitted, source], 1)
        self._chosen_to_fit = fitted
        self._batches.set_views(fitted)
        is_last = self.course.until >= self.steps
        if self._average is not None and (is_last or place >= self.steps * (1 - self.settings.average)):
            self._average.start()

    def _chosen_of(self, values, fitted: bool = False):
        """Take the entries of the chosen views, from tensors or cameras of leading shape [scenes, views].

        Args:
            fitted: with the input view, where it is fitted.
        """
        chosen = self._chosen_to_fit if fitted else self._chosen
        return values if chosen is None else values[torch.arange(len(chosen), device=chosen.device)[:, None], chosen]

    def _of_all_views(self, chosen: Float[Tensor, "scenes chosen *rest"]) -> Float[Tensor, "scenes views *rest"]:
        """Put what the chosen views have among zeros for the others."""
        if self._chosen is None:
            return chosen
        return with_views(chosen.new_zeros(*self.cameras.shape, *chosen.shape[2:]), self._chosen, chosen)

    def _weigh(self, rendered: SceneImages | None, targets: SceneImages) -> None:
        """Set how much rays weigh where a teacher says so of views, and how often they are drawn where errors say so.

        The input view weighs 1, and its rays are drawn as often as if all were alike.
        """
        weights, of_views = targets.new_ones(targets.shape[:2])[..., None, None], self.teachers[0].view_weights
        if of_views is not None:
            weights = torch.stack([teacher.view_weights for teacher in self.teachers])[..., None, None]
        by_error = self.settings.error_rays if rendered is not None else 0
        shares = self._error_shares(rendered, targets, by_error) if by_error else torch.ones_like(weights)
        if of_views is None and not by_error:
            return
        of_all = (weights / shares.clamp_min(1e-8)).expand(*targets.shape[:2], *targets.shape[-2:])
        if self.settings.fit_source:
            source = torch.ones_like(of_all[:, :1])
            of_all, shares = torch.cat([of_all, source], 1), torch.cat([shares.expand_as(of_all), source], 1)
        self._batches.set_weights(of_all)
        if by_error:
            self._batches.set_shares(shares)

    def _error_shares(
        self, rendered: SceneImages, targets: SceneImages, by_error: float
    ) -> Float[Tensor, "scenes views height width"]:
        """Return how often rays of the chosen views are drawn, 1 on average; a pixel's neighbours count as it does."""
        errors = (targets - rendered).square().mean(2).sqrt()
        errors = F.avg_pool2d(errors, 3, 1, 1, count_include_pad=False)
        chosen = self._of_all_views(self._chosen_of(torch.ones_like(errors)))  # targets of the others are no news
        mean = ((errors * chosen).flatten(1).sum(1) / chosen.flatten(1).sum(1))[:, None, None, None]
        relative = torch.where(mean > 0, errors / mean, 1.0)  # where there is no error all rays are alike
        return chosen * (1 - by_error + by_error * relative)

    @timed("fit")
    def _fit(self, targets: SceneImages) -> Float[Tensor, "steps scenes"]:
        """Take N inner steps; return their losses."""
        steps = self.settings.inner_steps
        if steps == 0:
            return targets.new_zeros(0, len(targets))
        self._rendered = None
        both = torch.cat([targets, self._source[:, None]], 1) if self.settings.fit_source else targets
        self._batches.set_colours(both)
        losses = self._inner.run(steps)
        for views in self.views:
            views.field_queries += steps * self._inner.queries
        return losses

    def _set_rates(self, decay: float) -> None:
        """Set the learning rates, in place: they are read when a recorded step is replayed."""
        rates = self.settings.lr_planes, self.settings.lr_decoder
        for group, rate in zip(self.optimizers().optimizer.param_groups, rates, strict=True):
            group["lr"].fill_(rate * decay)

    def _keep_finite(self, losses: Float[Tensor, "steps scenes"], targets: SceneImages) -> None:
        """Keep the fields of scenes that are still finite, without waiting for the device. Others stay as they were."""
        self._finite &= torch.isfinite(losses).all(0) & self.field.finite() & torch.isfinite(targets).flatten(1).all(1)
        self._finite_on_host.copy_(
            self._finite, non_blocking=True
        )  # read without waiting: on a GPU it may be a step old
        if self._good is self._start:
            self._last_targets = targets
        keep = self._finite.reshape(-1, 1, 1, 1, 1)
        self._last_targets = torch.where(keep, targets, self._last_targets)
        self._good = choose(self._finite, self.field.snapshot(), self._good)

    def _render_guidance(self) -> SceneImages:
        """Render the chosen views, unless the field and they are those that were rendered last; zeros for the others.
        Where coarse weights are kept, the input view is rendered too if fitted."""
        if self._rendered is None:
            cameras = self._fitted if self.keeps_coarse else self.cameras
            cameras = self._chosen_of(cameras, fitted=self.keeps_coarse)
            renderer = self.settings.guidance(self._renderer)
            leaves_empty = renderer.skip != "none" and self.settings.empty_below > 0
            if leaves_empty and self._chosen is None and not self.keeps_coarse:
                return self._render_again(renderer)
            rendering = self._render(cameras, renderer, self.keeps_coarse)
            if rendering.coarse is not None:
                self._batches.set_coarse(rendering.coarse.repeat_interleave(self._split, -1) / self._split)
            views = self.cameras.shape[1] if self._chosen is None else self._chosen.shape[1]
            self._rendered = self._of_all_views(rendering.images[:, :views])
        return self._rendered

    @torch.no_grad()
    def _render_again(self, renderer: Renderer) -> SceneImages:
        """Render the virtual views' pixels that are not empty (`FitSettings.empty_below`). Waits for the device."""
        settings, times = self.settings, self._seen_times
        self._seen_times += 1
        if times % settings.whole_every == 0:
            whole = self._render(self.cameras, renderer)
            self._seen = whole.images, whole.opacity
        else:
            images, opacity = self._seen
            side = 2 * settings.empty_reach + 1
            near = (F.max_pool2d(opacity, side, 1, settings.empty_reach) >= settings.empty_below).flatten(1)
            # the same number in each scene: where one has fewer, some that are empty are rendered, and not taken
            picked = near.sort(dim=1, descending=True, stable=True).indices[:, : int(near.sum(1).max())]
            rendering = renderer.render(self.field.field(), self._batches.at(picked)[0])
            for views in self.views:
                views.field_queries += renderer.samples_per_ray * picked.shape[1]

            def put(values: Tensor, rendered: Tensor) -> Tensor:
                each = picked[..., None].expand(rendered.shape)
                taken = torch.where(
                    near.gather(1, picked)[..., None], rendered.to(values.dtype), values.gather(1, each)
                )
                return values.scatter(1, each, taken)

            colours = put(images.movedim(2, -1).flatten(1, 3), rendering.rgb)
            images = colours.reshape(*opacity.shape, 3).movedim(-1, 2)
            opacity = put(opacity.flatten(1)[..., None], rendering.opacity[..., None]).reshape(opacity.shape)
            self._seen = images, opacity
        self._rendered = self._seen[0]
        return self._rendered

    @property
    def _renderer(self) -> Renderer:
        return self.views[0].model.renderer

    @torch.no_grad()
    def _render(self, cameras: Cameras, renderer: Renderer, keep_coarse: bool = False) -> RenderedViews:
        rendering = self.field.render(renderer, cameras, keep_coarse)
        for views in self.views:
            views.field_queries += renderer.samples_per_ray * rendering.opacity[0].numel()
        return rendering

    def _render_source(self) -> Float[Tensor, "scenes 3 height width"]:
        return self._render(self.field.cameras[:, None], self._renderer).images[:, 0]


def _mse(images: Float[Tensor, "scenes *rest"], others: Float[Tensor, "scenes *rest"]) -> Float[Tensor, "scenes"]:
    return (images - others).square().flatten(1).mean(1)
