"""Π for ABO: the scene's own relative poses."""

import logging
from dataclasses import dataclass
from functools import cache

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import all_cameras, with_source_lens

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OwnViews:
    """The input camera and those of the views to predict, spread evenly if there are more than K.

    Of these views nothing but the poses is used, which ABO's renders share among all objects. Where there are fewer
    than K, as with `data.eval_stride` above 1, a log line says so once.

    Args:
        views: K at most; ABO has 30 (paper).
    """

    views: int

    def __call__(self, scene: ViewBatch) -> Cameras:
        c2w = all_cameras(scene).c2w
        if len(c2w) < self.views:
            _warn_of_fewer(len(c2w), self.views)
        count = min(self.views, len(c2w))
        return with_source_lens(c2w[[i * len(c2w) // count for i in range(count)]], scene)


@cache
def _warn_of_fewer(there: int, asked: int) -> None:
    log.warning(
        "prior=abo_views: %d virtual views instead of the %d of budget.views: a scene has no more cameras "
        "(data.eval_stride above 1 leaves some out)",
        there,
        asked,
    )
