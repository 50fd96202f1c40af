"""NeRF-guided distillation: all views follow the reverse process together, drawn towards the field (Algorithm 1)."""

from nerfdiff.diffusion.deep_features import DeepReuse
from nerfdiff.diffusion.sampler import make_sampler, time_steps
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma
from nerfdiff.distill.guidance import Guidance
from nerfdiff.distill.teacher import sees_current
from nerfdiff.distill.virtual_views import Images, VirtualViews


class GuidedViews:
    """One step of every view, guided, each time targets are asked for.

    Args:
        views: to follow.
        steps: diffusion steps from `t_max` to `t_min` (paper: 64).
        spacing: of the times, `uniform_t` or `uniform_lambda`.
        sampler: `ddim` or `dpmpp_2m`; the guided images take the place of the denoised ones in either.
        eta: DDIM's η.
        guidance: towards the field's renderings.
        condition: the rendering that the CDM sees: the `first`, of the single-image NeRF, or the `current` one.
        deep: how often the CDM's deep levels are computed; None: at each step.

    Raises:
        ConfigError: another `condition`, sampler or spacing, or times or an eta that cannot be.
    """

    follows_field = True

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        t_max: float,
        t_min: float,
        spacing: str,
        sampler: str,
        eta: float,
        guidance: Guidance,
        condition: str,
        deep: DeepReuse | None = None,
    ):
        self.views, self.steps, self.guidance = views, steps, guidance
        self.sampler, self._deep = make_sampler(sampler, eta), views.reusing(deep)
        self.on_current = sees_current(condition)
        # what is recorded of a step is computed on the host, where nothing waits for the device
        self._host_times = time_steps(steps, t_max, t_min, spacing)
        self.times = self._host_times.to(views.encoding.source.device)
        self.t: float | None = None
        self.weight: float | None = None
        self._last = 2 * views.first_renderings - 1
        # Algorithm 1 begins with the renderings, noised: for t_max = 1 that is noise alone
        self._z = add_noise(self._last, views.noise(), *alpha_sigma(self.times[0]))

    def targets(self, step: int, rendered: Images) -> Images:
        t, t_next = self.times[step], self.times[step + 1]
        condition = rendered if self.on_current else None
        x0 = self.views.denoise(self._z, t.expand(len(self._z)), condition, self._deep)
        self._last = self.guidance(x0, 2 * rendered - 1, self._last, t)
        recorded = self._host_times[step]
        self.t, self.weight = float(recorded), float(self.guidance.weight(recorded))
        noise = self.views.noise() if self.sampler.needs_noise else None
        self._z = self.sampler.step(self._z, self._last, t, t_next, noise)
        return 0.5 * (self._last + 1)
