"""Scenes as every dataset reader yields them, whatever lay on disk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.utils.errors import DataError


class MissingSplit(DataError):
    """The dataset is there, but not the split that was asked for."""


@dataclass(frozen=True)
class Scene:
    """Posed images of one scene.

    Args:
        id: the scene's name within its dataset.
        views: names (file stems) of the views, in the order of `pixels`.
        pixels: 8-bit colours, what is transparent or masked out being white (they become floats only where they are
            used).
        cameras: one camera per image, in the dataset's world.
        near, far: bounds of the scene as distances along rays, in scene units.
        mask: foreground, where the dataset knows it.
        depth: distance along z in scene units, 0 where nothing was hit, where the dataset knows it.
    """

    id: str
    views: tuple[str, ...]
    pixels: UInt8[Tensor, "views 3 height width"]
    cameras: Cameras
    near: float
    far: float
    mask: Bool[Tensor, "views height width"] | None = None
    depth: Float[Tensor, "views height width"] | None = None

    @property
    def images(self) -> Float[Tensor, "views 3 height width"]:
        """Colours in [0, 1]."""
        return self.pixels.float() / 255


@dataclass(frozen=True)
class Listing:
    """All views of a scene, as far as no image need be decoded.

    Args:
        c2w: camera-to-world with OpenCV axes, in the dataset's world.
        files: by view name, the files that reading the view and its ground truth takes; whether they exist is not
            looked up.
    """

    c2w: Float[np.ndarray, "views 4 4"]
    files: Mapping[str, Sequence[Path]]


@runtime_checkable
class SceneReader(Protocol):
    """One split of one dataset: an ordered collection of scenes read lazily from disk."""

    identity: str
    """Names the folder and settings that are read: two readers of one identity read the same files alike."""
    nearest_view: bool
    """True if the number of a view that a scene lacks stands for the nearest one that it has."""

    def __len__(self) -> int:
        """Number of scenes."""

    def fingerprint(self) -> str:
        """Digest of names and times of change of the files, or of their folders, that images and cameras come from.

        Each reader says which changes it does not notice.
        """

    def scene_id(self, index: int) -> str:
        """Name of scene `index` within the dataset."""

    def view_names(self, index: int) -> tuple[str, ...]:
        """Sorted names of the views of scene `index`, without decoding images."""

    def listing(self, index: int) -> Listing:
        """Poses and files of all views of scene `index`.

        Raises:
            DataError: as `load`, but for what only decoding shows.
        """

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        """Read the views at these positions of `view_names` (all where None).

        Args:
            truth: also read ground-truth mask and depth, where the dataset has them.

        Raises:
            DataError: a file is missing, damaged or inconsistent; the message names it.
        """
