"""Settings of the fit of a field to images of a scene at test time."""

import math
from dataclasses import dataclass, replace

from nerfdiff.render.renderer import Renderer
from nerfdiff.utils.errors import ConfigError

DECAYS = {
    "none": lambda done: 1.0,
    "linear": lambda done: 1 - done,
    "cosine": lambda done: 0.5 * (1 + math.cos(math.pi * done)),
}
"""Factors of the learning rates, by the share of the teacher's steps that are done."""

COARSE = ("every_step", "refresh")
"""Choices of when coarse weights are computed."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the inner steps (paper, appendix, "Finetuning phase"); `conf/common/distillation.yaml` has them.

    Args:
        inner_steps: N, Adam steps after each of the teacher's.
        rays: B, per inner step and scene.
        lr_planes, lr_decoder: learning rates of W and θ.
        lr_decay: of both, over the teacher's steps: `none`, `linear` or `cosine`.
        fit_source: whether the input image, the one view that is known, is fitted beside the virtual views.
        target_tolerance, source_tolerance: dB by which the last targets and the input view may be explained worse
            before a scene falls back to its first field.
        coarse: when the weights are computed from which importance samples are drawn: at `every_step` of the inner
            ones, or at each `refresh`, when the field is rendered for the teacher anyway: inner steps then evaluate all
            their samples at once. Kept weights take 2 bytes for each bin of each ray of all views. Where teachers do
            not follow the field, nothing is rendered between inner steps, and weights are computed at every step.
        cuda_graphs: record an inner step once and replay it, on a GPU.
        guidance_uniform_samples, guidance_importance_samples: per ray, where the field is rendered for the teacher;
            None, or more than the model has: the model's.
        average: share of the teacher's steps, up to the last, over whose inner steps planes and decoder are averaged;
            the mean is kept. 0 keeps what the last step left.
        error_rays: share of the rays that are drawn where the last renderings differ from the targets, in proportion to
            how much; each weighs as much less as it is drawn more often. 0 draws all alike.
        rays_share: of B, that are drawn.
        steps_share: of the teacher's steps, that are taken, each longer.
        patience: steps in which the field's renderings agree no better with the denoised images, after which what is
            left of the schedule is one step; None: all steps are taken.
        rise: dB by which they have to agree better.
        empty_below: opacity below which a pixel of a rendering for the teacher is empty. It keeps its colour where all
            within `empty_reach` pixels of it are, but for every `whole_every`-th rendering. 0 renders all every time,
            as do `views_last` and `coarse=refresh`.
        views_last: number of virtual views that are left at the last step, see `VirtualViews.choose`; None keeps all.

    Raises:
        ConfigError: another `lr_decay` or `coarse`, no rays, negative steps, shares or opacities outside [0, 1], or no
            view or uniform samples.
    """

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
    guidance_uniform_samples: int | None = None
    guidance_importance_samples: int | None = None
    average: float = 0.0
    views_last: int | None = None
    error_rays: float = 0.0
    rays_share: float = 1.0
    steps_share: float = 1.0
    patience: int | None = None
    rise: float = 0.0
    empty_below: float = 0.0
    empty_reach: int = 2
    whole_every: int = 4

    def __post_init__(self):
        if self.rays < 1 or self.inner_steps < 0:
            raise ConfigError(f"rays={self.rays} must be at least 1 and inner_steps={self.inner_steps} at least 0")
        if self.lr_decay not in DECAYS:
            raise ConfigError(f"strategy.lr_decay={self.lr_decay!r}: choose {', '.join(DECAYS)}")
        if self.coarse not in COARSE:
            raise ConfigError(f"strategy.coarse={self.coarse!r}: choose {', '.join(COARSE)}")
        if not 0 <= self.average <= 1:
            raise ConfigError(f"strategy.average={self.average}: expected a share of the steps, from 0 to 1")
        if not 0 <= self.error_rays < 1:
            raise ConfigError(f"strategy.error_rays={self.error_rays}: expected a share of rays from 0 to less than 1")
        for name in ("rays_share", "steps_share"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"strategy.{name}={getattr(self, name)}: expected a share above 0, to 1")
        if self.patience is not None and self.patience < 1:
            raise ConfigError(f"strategy.patience={self.patience} must be at least 1; null takes all steps")
        if not 0 <= self.empty_below < 1:
            raise ConfigError(f"strategy.empty_below={self.empty_below}: expected an opacity from 0 to less than 1")
        if self.empty_reach < 0 or self.whole_every < 1:
            raise ConfigError(
                f"strategy.empty_reach={self.empty_reach} must be at least 0 and "
                f"strategy.whole_every={self.whole_every} at least 1"
            )
        if self.views_last is not None and self.views_last < 1:
            raise ConfigError(f"strategy.views_last={self.views_last} must be at least 1; null keeps all views")
        for name, least in (("uniform", 1), ("importance", 0)):
            key = f"guidance_{name}_samples"
            if (count := getattr(self, key)) is not None and count < least:
                raise ConfigError(f"strategy.{key}={count} must be at least {least}, or null for the model's")

    def guidance(self, renderer: Renderer) -> Renderer:
        """Return the renderer of the images for the teacher."""
        given = self.guidance_uniform_samples, self.guidance_importance_samples
        own = renderer.uniform_samples, renderer.importance_samples
        uniform, importance = (most if n is None else min(n, most) for n, most in zip(given, own, strict=True))
        return replace(renderer, uniform_samples=uniform, importance_samples=importance)
