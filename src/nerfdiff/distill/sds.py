"""Score distillation: fit the field to its renderings, noised at random t and denoised (paper, appendix).

The rule is DreamFusion's (arXiv 2209.14988) with x0 as the target of L2, instead of a gradient on the noise.
"""

from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, expand
from nerfdiff.distill.teacher import uses_current_rendering
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed, to_unit


class SDSTeacher:
    """Noise every view's rendering to a time of its own and denoise it in one step.

    Args:
        views: whose renderings are denoised.
        steps: how many times targets are asked for; each costs as many denoiser calls as a step of NGD.
        t_max, t_min: times are uniform between them.
        condition: the rendering that conditions the CDM: the `first` or the `current` one.

    Raises:
        ConfigError: another `condition`, or times or steps that cannot be.
    """

    t = weight = None
    follows_field = True

    def __init__(self, views: VirtualViews, steps: int, t_max: float, t_min: float, condition: str):
        if not 0 <= t_min <= t_max <= 1 or steps < 1:
            raise ConfigError(f"t_min={t_min}, t_max={t_max}, steps={steps}: need 0 <= t_min <= t_max <= 1, steps >= 1")
        self.views, self.steps = views, steps
        self.t_max, self.t_min = t_max, t_min
        self.on_current = uses_current_rendering(condition)

    def targets(self, step: int, rendered: Images) -> Images:
        t = self.t_min + (self.t_max - self.t_min) * self.views.uniform()
        alpha, sigma = (expand(c, rendered) for c in alpha_sigma(t))
        z = add_noise(to_signed(rendered), self.views.noise(), alpha, sigma)
        return to_unit(self.views.denoise(z, t, rendered if self.on_current else None))
