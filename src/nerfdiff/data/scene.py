"""What every dataset reader yields, whatever lay on disk."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras


@dataclass(frozen=True)
class Scene:
    """Posed images of one scene.

    Args:
        id: the scene's name within its dataset.
        views: names (file stems) of the views, in the order of `images`.
        images: colours in [0, 1], composited on white.
        cameras: one camera per image, in the dataset's world.
        near, far: bounds of the scene as distances along rays, in scene units.
        mask: foreground, where the dataset knows it.
        depth: distance along z in scene units, 0 where nothing was hit, where the dataset knows it.
    """

    id: str
    views: tuple[str, ...]
    images: Float[Tensor, "views 3 height width"]
    cameras: Cameras
    near: float
    far: float
    mask: Bool[Tensor, "views height width"] | None = None
    depth: Float[Tensor, "views height width"] | None = None


class SceneReader(Protocol):
    """One split of one dataset: an ordered collection of scenes read lazily from disk."""

    near: float
    far: float

    def __len__(self) -> int:
        """Number of scenes."""

    def view_names(self, index: int) -> tuple[str, ...]:
        """Sorted names of the views of scene `index`, without decoding images."""

    def load(self, index: int, views: Sequence[int] | None = None) -> Scene:
        """Read the views at these positions of `view_names` (all where None).

        Raises:
            DataError: a file is missing, damaged or inconsistent; the message names it.
        """
