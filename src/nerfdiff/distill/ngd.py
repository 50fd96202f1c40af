"""NeRF-guided distillation: all views follow the reverse process together, drawn towards the field (Algorithm 1)."""

from nerfdiff.diffusion.ddim import ddim_step, time_steps
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma
from nerfdiff.distill.guidance import Guidance
from nerfdiff.distill.teacher import sees_current
from nerfdiff.distill.virtual_views import Images, VirtualViews


class GuidedViews:
    """One DDIM step of every view, guided, each time targets are asked for.

    Args:
        views: to follow.
        steps: DDIM steps from `t_max` to `t_min` (paper: 64).
        eta: DDIM's η.
        guidance: towards the field's renderings.
        condition: the rendering that the CDM sees: the `first`, of the single-image NeRF, or the `current` one.

    Raises:
        ConfigError: another `condition`.
    """

    follows_field = True

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        t_max: float,
        t_min: float,
        eta: float,
        guidance: Guidance,
        condition: str,
    ):
        self.views, self.steps, self.eta, self.guidance = views, steps, eta, guidance
        self.on_current = sees_current(condition)
        self.times = time_steps(steps, t_max, t_min, device=views.encoding.source.device)
        self.t: float | None = None
        self.weight: float | None = None
        self._last = 2 * views.first_renderings - 1
        # Algorithm 1 begins with the renderings, noised: for t_max = 1 that is noise alone
        self._z = add_noise(self._last, views.noise(), *alpha_sigma(self.times[0]))

    def targets(self, step: int, rendered: Images) -> Images:
        t, t_next = self.times[step], self.times[step + 1]
        x0 = self.views.denoise(self._z, t.expand(len(self._z)), rendered if self.on_current else None)
        self._last = self.guidance(x0, 2 * rendered - 1, self._last, t)
        self.t, self.weight = float(t), float(self.guidance.weight(t))
        self._z = ddim_step(self._z, self._last, t, t_next, self.eta, self.views.noise() if self.eta > 0 else None)
        return 0.5 * (self._last + 1)
