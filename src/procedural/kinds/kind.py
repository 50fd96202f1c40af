"""Base of all kinds of scene: one job per scene, all randomness from its place in the set."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nerfdiff.utils.errors import ConfigError
from procedural.mitsuba_renderer import Film, MitsubaRenderer


@dataclass(frozen=True)
class SceneJob:
    """One scene to render into `root`."""

    root: Path
    split: str
    index: int
    views: int


@runtime_checkable
class SceneKind(Protocol):
    """One kind of scene: what is in it, where its cameras are, how its files are laid out.

    Built from the whole configuration of `conf/make_scenes.yaml`; impossible values raise `ConfigError`.
    """

    category: str
    film: Film

    def parameters(self) -> dict[str, Any]:
        """All settings of this kind alone that files depend on."""

    def split_folder(self, split: str) -> str:
        """Return a split's folder, relative to the root."""

    def complete(self, job: SceneJob) -> bool:
        """Return true if the scene is there already."""

    def make(self, job: SceneJob, renderer: MitsubaRenderer) -> None:
        """Render the scene and write its files, all or none.

        Raises:
            DataError: the scene cannot be written.
        """

    def images(self, job: SceneJob) -> list[Path]:
        """The scene's pictures, in the order of views."""

    def finish(self, root: Path) -> None:
        """Write what describes all scenes together.

        Raises:
            DataError: it cannot be written.
        """


def stream(seed: int, category: str, job: SceneJob, purpose: str) -> np.random.Generator:
    """Independent streams for shape, cameras and noise: more views do not change the object.

    They follow from (seed, category, split, index) alone, never from the process that happens to render.
    """
    words = [zlib.crc32(word.encode()) for word in (category, job.split, purpose)]
    return np.random.default_rng([seed, job.index, *words])


def check_styles(styles: Mapping[str, Any], known: Sequence[str], category: str) -> None:
    """Refuse weights of kinds that do not exist, and impossible weights."""
    unknown = sorted(set(styles) - set(known))
    if unknown:
        raise ConfigError(f"scenes.styles: unknown {', '.join(unknown)}; {category} come as {', '.join(known)}")
    if any(weight < 0 for weight in styles.values()) or not sum(styles.values()) > 0:
        raise ConfigError(f"scenes.styles={dict(styles)}: expected weights of at least 0, one of them above 0")


def check_splits(splits: Mapping[str, Any], known: Sequence[str], category: str) -> None:
    """Refuse splits that the layout does not have."""
    if not splits or set(splits) - set(known):
        raise ConfigError(f"splits={sorted(splits)}: {category} expect some of {', '.join(known)}")


def ascending(name: str, values: Sequence[Any], low: float, high: float = float("inf")) -> tuple[Any, Any]:
    """Two values low <= a <= b <= high, or a `ConfigError` naming the key."""
    numbers = len(values) == 2 and all(isinstance(value, (int, float)) for value in values)
    if not numbers or not low <= values[0] <= values[1] <= high:
        raise ConfigError(f"{name}={list(values)}: expected two ascending numbers from {low:g} to {high:g}")
    return tuple(values)
