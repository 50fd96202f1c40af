"""NeRF-guided distillation (NerfDiff, arXiv 2302.10109, Algorithm 1): all views follow the reverse process together,
each denoised image drawn towards the field's rendering of it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.diffusion.sampler import SamplerSettings, time_at
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma
from nerfdiff.distill.autoguidance import Autoguidance
from nerfdiff.distill.teacher import uses_current_rendering
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.utils.config import from_keys
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed, to_unit

SCHEDULES = ("snr", "constant", "linear")
COMPARISONS = ("current", "last")
AT_FULL_GUIDANCE = ("everything", "fit", "nothing")
"""Choices of what is computed where renderings take the place of the denoised images."""


@dataclass(frozen=True)
class Guidance:
    """NeRF guidance (paper, eq. "eps_guide"): how strongly denoised images are drawn to the field's renderings.

    ε̃ = ε + γ (σ/α) (I − I_θ) is x̃0 = x0 − w (I − I_θ) with w = γ σ²/α²: for I = x0, a blend of x0 and the rendering.
    For w > 1 that overshoots and for w > 2 it diverges, and σ²/α² grows without bound as t → 1; so w is clamped to
    [0, 1], whose upper end is the remark of the paper that γ = SNR replaces the denoised images by the renderings.

    Args:
        schedule: `snr` is the paper's w = γ σ²/α²; `constant` is w = γ; `linear` is w = γ t.
        gamma: γ >= 0; 0 is plain sampling.
        compare: which image I the rendering is compared with: this step's (`current`, the paper's equation) or the
            `last` step's (its Algorithm 1).
        t_min: time below which there is no guidance, so that fine detail is the CDM's own (MVEdit, arXiv 2403.12032).

    Raises:
        ConfigError: a value is none of these.
    """

    schedule: str
    gamma: float
    compare: str
    t_min: float = 0.0

    def __post_init__(self):
        if self.schedule not in SCHEDULES:
            raise ConfigError(f"guidance.schedule={self.schedule!r}: choose {', '.join(SCHEDULES)}")
        if self.compare not in COMPARISONS:
            raise ConfigError(f"guidance.compare={self.compare!r}: choose {', '.join(COMPARISONS)}")
        if not self.gamma >= 0:
            raise ConfigError(f"guidance.gamma={self.gamma} must be at least 0")
        if not 0 <= self.t_min <= 1:
            raise ConfigError(f"guidance.t_min={self.t_min}: expected a time from 0, which guides always, to 1")

    def weight(self, t: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Return w in [0, 1] at time t; finite at both ends."""
        return torch.where(t < self.t_min, 0.0, self._scheduled(t))

    def _scheduled(self, t: Float[Tensor, ""]) -> Float[Tensor, ""]:
        if self.schedule == "snr":
            alpha, sigma = alpha_sigma(t)
            # γσ² / α² without dividing by zero: at t = 1 any γ > 0 reaches the clamp
            numerator = self.gamma * sigma**2
            return torch.where(numerator >= alpha**2, float(self.gamma > 0), numerator / (alpha**2).clamp_min(1e-12))
        return (self.gamma * (t if self.schedule == "linear" else torch.ones_like(t))).clamp(0, 1)

    def replaces(self, t: Float[Tensor, ""]) -> bool:
        """Return true if at time t the guided images are the renderings, whatever the denoised ones are."""
        return self.compare == "current" and bool(self.weight(t) == 1)

    def __call__(
        self,
        x0: Float[Tensor, "views 3 height width"],
        rendered: Float[Tensor, "views 3 height width"],
        last: Float[Tensor, "views 3 height width"],
        t: Float[Tensor, ""],
    ) -> Float[Tensor, "views 3 height width"]:
        """Guide denoised images.

        Args:
            x0, rendered, last: the denoised images, the field's renderings and the last step's x̃0, all in [-1, 1].

        Returns:
            x̃0, clamped to [-1, 1], which a difference to the last step's image could leave.
        """
        weight = self.weight(t)
        # the first of the two is exact at both ends of w
        guided = x0.lerp(rendered, weight) if self.compare == "current" else x0 - weight * (last - rendered)
        return guided.clamp(-1, 1)


@from_keys(sampling=SamplerSettings)
class NGDTeacher:
    """Take one guided step of the reverse process for every view, each time targets are asked for.

    Args:
        views: to sample.
        steps: diffusion steps (paper: 64).
        sampling: the guided images take the place of the denoised ones in any sampler.
        guidance: towards the field's renderings.
        condition: the rendering that conditions the CDM: the `first`, of the single-image NeRF, or the `current` one.
        at_full_guidance: what is computed in steps whose guided images are the renderings (w = 1): `everything`; `fit`,
            the inner steps without the denoiser, whose images would not be used (the same result, where deep levels
            are computed at each call); or `nothing`: fitting a field to its own renderings only blurs it.
        autoguidance: by an earlier snapshot.

    Raises:
        ConfigError: another `condition` or `at_full_guidance`, or a sampler, spacing, times or eta that cannot be.
    """

    follows_field = True
    view_weights = None

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        sampling: SamplerSettings,
        guidance: Guidance,
        condition: str,
        at_full_guidance: str = "fit",
        autoguidance: Autoguidance | None = None,
    ):
        if at_full_guidance not in AT_FULL_GUIDANCE:
            known = ", ".join(AT_FULL_GUIDANCE)
            raise ConfigError(f"teacher.at_full_guidance={at_full_guidance!r}: choose {known}")
        self.at_full_guidance = at_full_guidance
        views.autoguide(autoguidance)
        self.views, self.steps, self.guidance = views, steps, guidance
        self.sampler, self._deep = sampling.begin(), views.deep_features(sampling.deep)
        self.on_current = uses_current_rendering(condition)
        # what is recorded of a step is computed on the host, where nothing waits for the device
        self._host_times = sampling.times(steps)
        self.times = self._host_times.to(views.encoding.source.device)
        self.t: float | None = None
        self.weight: float | None = None
        self.gap: Float[Tensor, ""] | None = None
        self._last = to_signed(views.first_renderings)
        # Algorithm 1 begins with the renderings, noised: for t_max = 1 that is noise alone
        self._z = add_noise(self._last, views.noise(), *alpha_sigma(self.times[0]))

    def targets(self, step: float | int, rendered: Images) -> Images | None:
        until = step + 1 if self.views.until is None else self.views.until
        t, t_next = time_at(self.times, step), time_at(self.times, until)
        recorded = time_at(self._host_times, step)
        self.t, self.weight = float(recorded), float(self.guidance.weight(recorded))
        replaced = self.guidance.replaces(recorded)
        if replaced and self.at_full_guidance != "everything":
            self._last, self.gap = to_signed(rendered).clamp(-1, 1), None
        else:
            # denoise
            condition = rendered if self.on_current else None
            x0 = self.views.denoise(self._z, t.expand(len(self._z)), condition, self._deep)
            # compared with the last images, guided ones overshoot by w: a schedule must not end where w is large
            is_blend = self.guidance.compare == "current"
            self.gap = self.views.distance(to_unit(x0), rendered) if is_blend else None
            # guide
            self._last = self.guidance(x0, to_signed(rendered), self._last, t)
        # step to the next time
        noise = self.views.noise() if self.sampler.needs_noise else None
        self._z = self.sampler.step(self._z, self._last, t, t_next, noise)
        return None if replaced and self.at_full_guidance == "nothing" else to_unit(self._last)
