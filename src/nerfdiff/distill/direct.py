"""Direct distillation: every view sampled once by itself, and the field fitted to what came out (paper, appendix)."""

from nerfdiff.diffusion.deep_features import DeepReuse
from nerfdiff.distill.cdm import sample_views
from nerfdiff.distill.virtual_views import Images, VirtualViews


class FixedImages:
    """The same images at every step.

    Args:
        images: in [0, 1], one per virtual view.
        steps: how many times they are asked for, to fit as long as the other methods do.
    """

    t = weight = None
    follows_field = False

    def __init__(self, images: Images, steps: int):
        self.images, self.steps = images, steps

    def targets(self, step: int, rendered: Images | None) -> Images:
        return self.images


class SampledViews(FixedImages):
    """Samples of the CDM.

    Args:
        views: to sample.
        steps: how many times targets are asked for, to fit as long as the other methods do.
        sampler_steps: diffusion steps from `t_max` to `t_min`.
        spacing, sampler, eta, deep: as for `sample_views`.
    """

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        sampler_steps: int,
        t_max: float,
        t_min: float,
        spacing: str,
        sampler: str,
        eta: float,
        deep: DeepReuse | None = None,
    ):
        super().__init__(sample_views(views, sampler_steps, t_max, t_min, spacing, sampler, eta, deep), steps)
