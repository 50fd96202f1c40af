"""Π: the cameras, relative to the input's, from which a scene is to be seen (paper, appendix, "Prior")."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch


@runtime_checkable
class Prior(Protocol):
    """Virtual cameras of a scene.

    Nothing else is read of a prior: rows record the name of its class, and as K how many cameras the scenes got.
    """

    def __call__(self, scene: ViewBatch) -> Cameras:
        """Cameras [1, K] in the input camera's space, with the input's intrinsics; `scene` is a batch of one."""


def with_source_lens(c2w: Float[Tensor, "views 4 4"], scene: ViewBatch) -> Cameras:
    """Cameras [1, views] with the input's intrinsics and image size."""
    own = scene.source_cameras
    return Cameras(c2w[None].to(own.K), own.K[:1, None].expand(1, len(c2w), 3, 3), own.height, own.width)


def all_cameras(scene: ViewBatch) -> Cameras:
    """The input camera, which is the identity, and after it the scene's others: [views]."""
    return Cameras.join([scene.source_cameras, scene.target_cameras[0]])
