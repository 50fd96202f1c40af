"""Π: the cameras, relative to the input's, from which a scene is to be seen (paper, appendix, "Prior")."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.scenes.poses import SPIRAL_VIEWS, srn_spiral


@runtime_checkable
class Prior(Protocol):
    """Virtual cameras of a scene."""

    def __call__(self, scene: ViewBatch) -> Cameras:
        """Cameras [1, K] in the input camera's space, with the input's intrinsics; `scene` is a batch of one."""


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
        radius = float(scene.near[0] + scene.far[0]) / 2
        spiral = torch.from_numpy(srn_spiral(radius)).to(scene.source_cameras.K)
        every = (np.arange(self.views) * (SPIRAL_VIEWS - 1) // self.views).tolist()
        return _relative(spiral[every], spiral[self.source_view], scene)


def _relative(c2w: Float[torch.Tensor, "views 4 4"], source: Float[torch.Tensor, "4 4"], scene: ViewBatch) -> Cameras:
    own = scene.source_cameras
    K = own.K[:1, None].expand(1, len(c2w), 3, 3)
    cameras = Cameras(c2w[None], K, own.height, own.width)
    return cameras.relative_to(Cameras(source[None, None], own.K[:1, None], own.height, own.width))
