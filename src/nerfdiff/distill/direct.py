"""Direct distillation: every view sampled once by itself, and the field fitted to what came out (paper, appendix)."""

from nerfdiff.diffusion.ddim import ddim_sample, time_steps
from nerfdiff.distill.virtual_views import Images, VirtualViews


class SampledViews:
    """The same samples of the CDM at every step.

    Args:
        views: to sample.
        steps: how many times targets are asked for, to fit as long as the other methods do.
        sampler_steps: DDIM steps from `t_max` to `t_min`.
        eta: DDIM's η.
    """

    weight = None

    def __init__(self, views: VirtualViews, steps: int, sampler_steps: int, t_max: float, t_min: float, eta: float):
        self.steps = steps
        times = time_steps(sampler_steps, t_max, t_min, device=views.encoding.source.device)
        x0 = ddim_sample(lambda z, t: views.denoise(z, t.expand(len(z))), views.noise(), times, eta, views.noise)
        self.images = (0.5 * (x0 + 1)).clamp(0, 1)

    def targets(self, step: int, rendered: Images) -> Images:
        return self.images
