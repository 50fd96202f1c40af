"""Score distillation: fit the field to its renderings, noised at random t and denoised (paper, appendix).

The rule is DreamFusion's (arXiv 2209.14988) with x0 as the target of L2, instead of a gradient on the noise.
"""

from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, expand
from nerfdiff.distill.teacher import uses_current_rendering
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed, to_unit

WEIGHTINGS = ("uniform", "sigma2")


class SDSTeacher:
    """Noise every view's rendering to a time of its own and denoise it in one step.

    DreamFusion's gradient on a rendering x is w(t) (ε̂ − ε), and ε̂ − ε is (α/σ)(x − x̂0): that of L2 between x and the
    denoised x̂0, weighed by w(t) α/σ. With its w(t) = σ² that is ασ, which is finite at both ends of t.

    Args:
        views: whose renderings are denoised.
        steps: how many times all views are denoised; each costs as many denoiser calls as a step of NGD.
        t_max, t_min: times are uniform between them.
        condition: the rendering that conditions the CDM: the `first` or the `current` one.
        weighting: of the views' losses: `uniform`, or DreamFusion's `sigma2` (2ασ, which is at most 1).
        views_per_step: views that are rendered, denoised and fitted at a time, chosen at random for each; targets are
            then asked for so many times that the denoiser calls in all are those of `steps` of all views. None: all.

    Raises:
        ConfigError: another `condition` or `weighting`, or times, steps or views that cannot be.
    """

    t = weight = gap = None
    follows_field = True

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        t_max: float,
        t_min: float,
        condition: str,
        weighting: str = "uniform",
        views_per_step: int | None = None,
    ):
        if not 0 <= t_min <= t_max <= 1 or steps < 1:
            raise ConfigError(f"t_min={t_min}, t_max={t_max}, steps={steps}: need 0 <= t_min <= t_max <= 1, steps >= 1")
        if weighting not in WEIGHTINGS:
            raise ConfigError(f"teacher.weighting={weighting!r}: choose {' or '.join(WEIGHTINGS)}")
        if views_per_step is not None and views_per_step < 1:
            raise ConfigError(f"teacher.views_per_step={views_per_step} must be at least 1; null takes all views")
        self.views, self.steps = views, steps
        self.t_max, self.t_min = t_max, t_min
        self.weighting, self.view_weights = weighting, None
        self.on_current = uses_current_rendering(condition)
        if views_per_step is not None:
            at_once = min(views_per_step, len(views))
            self.steps = -(-steps * len(views) // at_once)
            views.choose_randomly(at_once, self.steps)

    def targets(self, step: float | int, rendered: Images) -> Images:
        t = self.t_min + (self.t_max - self.t_min) * self.views.uniform()
        alpha, sigma = alpha_sigma(t)
        self.view_weights = 2 * alpha * sigma if self.weighting == "sigma2" else None
        z = add_noise(to_signed(rendered), self.views.noise(), expand(alpha, rendered), expand(sigma, rendered))
        return to_unit(self.views.denoise(z, t, rendered if self.on_current else None))
