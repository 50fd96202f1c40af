"""Π for SRN-ShapeNet: its test trajectory."""

from dataclasses import dataclass

import numpy as np
import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.priors.prior import with_source_lens
from nerfdiff.scenes.poses import SPIRAL_VIEWS, srn_spiral


@dataclass(frozen=True)
class SRNSpiral:
    """Evenly chosen cameras of SRN's test spiral, relative to its view `source_view`: no pose file is needed.

    The spiral's radius is the middle of near and far, as for SRN's cars (0.8, 1.3, 1.8) and chairs (1.25, 2, 2.75).

    Args:
        views: K; 50 takes every fifth of the 251 views (paper).
        source_view: the view that the input image is.
    """

    views: int
    source_view: int

    def __call__(self, scene: ViewBatch) -> Cameras:
        spiral = torch.from_numpy(srn_spiral(float(scene.near[0] + scene.far[0]) / 2))
        every = (np.arange(self.views) * (SPIRAL_VIEWS - 1) // self.views).tolist()
        source = with_source_lens(spiral[[self.source_view]], scene)
        return with_source_lens(spiral[every], scene).relative_to(source)
