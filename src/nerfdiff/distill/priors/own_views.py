"""Π for ABO: the scene's own relative poses."""

from dataclasses import dataclass

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import all_cameras, with_source_lens


@dataclass(frozen=True)
class OwnViews:
    """The input camera and those of the views to predict, spread evenly if there are more than K.

    Of these views nothing but the poses is used, which ABO's renders share among all objects. With
    `data.eval_stride` above 1 there are fewer of them.

    Args:
        views: K at most; ABO has 30 (paper).
    """

    views: int

    def __call__(self, scene: ViewBatch) -> Cameras:
        c2w = all_cameras(scene).c2w
        count = min(self.views, len(c2w))
        return with_source_lens(c2w[[i * len(c2w) // count for i in range(count)]], scene)
