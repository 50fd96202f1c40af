"""Direct distillation: sample every view once by itself, and fit the field to the samples (paper, appendix)."""

from nerfdiff.diffusion.sampler import SamplerSettings
from nerfdiff.distill.autoguidance import Autoguidance
from nerfdiff.distill.cdm import sample_views
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.utils.config import from_keys


class FixedTeacher:
    """Give the same images at every step.

    Args:
        images: in [0, 1], one per virtual view.
        steps: how many times they are asked for, to fit as long as the other methods do.
    """

    t = weight = view_weights = gap = None
    follows_field = False

    def __init__(self, images: Images, steps: int):
        self.images, self.steps = images, steps

    def targets(self, step: float | int, rendered: Images | None) -> Images:
        return self.images


@from_keys(sampling=SamplerSettings)
class DirectTeacher(FixedTeacher):
    """Give samples of the CDM.

    Args:
        views: to sample.
        steps: see `FixedTeacher`.
        sampler_steps: diffusion steps.
        sampling: see `sample_views`.
        autoguidance: by an earlier snapshot.
    """

    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        sampler_steps: int,
        sampling: SamplerSettings,
        autoguidance: Autoguidance | None = None,
    ):
        views.autoguide(autoguidance)
        super().__init__(sample_views(views, sampler_steps, sampling), steps)
