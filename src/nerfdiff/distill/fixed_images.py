"""Targets that are made beforehand, whatever the field shows: what `direct` and `stochastic` share."""

from nerfdiff.distill.virtual_views import Images


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
