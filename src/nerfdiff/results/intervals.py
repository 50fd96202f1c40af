"""Bootstrap intervals of means over scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerfdiff.utils.errors import ConfigError


class Estimate(NamedTuple):
    """A mean, and the ends of its interval or range; None where one value alone says nothing of either."""

    mean: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Bootstrap:
    """Percentile intervals of means over scenes drawn with replacement (Efron, 1979).

    Args:
        resamples: draws of as many scenes as there are.
        level: of the interval.
        seed: of the draws. For as many scenes they are the same scenes, whatever is measured on them.

    Raises:
        ConfigError: a value is out of range.
    """

    resamples: int
    level: float
    seed: int

    def __post_init__(self):
        if self.resamples < 1 or not 0 < self.level < 1:
            raise ConfigError(f"bootstrap: resamples={self.resamples} must be at least 1, level={self.level} in (0, 1)")

    def __call__(self, values: Float[np.ndarray, "scenes"]) -> Estimate:
        """The mean over scenes and its interval, which needs two of them."""
        mean = float(values.mean())
        if len(values) < 2:
            return Estimate(mean)
        drawn = _drawn(self.seed, self.resamples, len(values))
        tails = (1 - self.level) / 2
        with np.errstate(invalid="ignore"):
            low, high = np.quantile(values[drawn].mean(axis=1), [tails, 1 - tails])
        return Estimate(mean, float(low), float(high))

    def means(self, values: Float[np.ndarray, "seeds scenes"]) -> Float[np.ndarray, "resamples"]:
        """The mean over seeds and scenes of every draw of both; for as many of both, the draws are the same."""
        seeds, scenes = values.shape
        scene_shares, seed_shares = _draws(self.seed, self.resamples, scenes, seeds)
        with np.errstate(invalid="ignore"):
            return ((seed_shares @ values) * scene_shares).sum(axis=1)

    def over_seeds_and_scenes(self, values: Float[np.ndarray, "metrics seeds scenes"]) -> list[Estimate]:
        """Per metric the mean over seeds and scenes and its interval: both are drawn, each independently of the other.

        With one seed these are the intervals over the scenes alone.
        """
        _, seeds, scenes = values.shape
        with np.errstate(invalid="ignore"):
            means = values.mean(axis=(1, 2))
        if seeds * scenes < 2:
            return [Estimate(float(mean)) for mean in means]
        tails = (1 - self.level) / 2
        found = []
        for mean, own in zip(means, values, strict=True):
            with np.errstate(invalid="ignore"):
                low, high = np.quantile(self.means(own), [tails, 1 - tails])
            found.append(Estimate(float(mean), float(low), float(high)))
        return found


@lru_cache(maxsize=4)
def _drawn(seed: int, draws: int, among: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(among, size=(draws, among))


@lru_cache(maxsize=4)
def _draws(seed: int, draws: int, scenes: int, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """The `_shares` of scenes and of seeds. Scenes first: they are the same as in the draws of one seed."""
    rng = np.random.default_rng(seed)
    return _shares(rng, draws, scenes), _shares(rng, draws, seeds)


def _shares(rng: np.random.Generator, draws: int, among: int) -> Float[np.ndarray, "draws among"]:
    """Draw with replacement as often as there are items; return each one's share."""
    drawn = rng.integers(among, size=(draws, among)) + among * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=draws * among).reshape(draws, among) / among


def mean_of(values: Sequence[float]) -> float:
    """The mean, of infinite numbers too."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(values))


def spread(values: Sequence[float]) -> Estimate:
    """The mean over runs and their range, where there are several."""
    return Estimate(mean_of(values), min(values), max(values)) if len(values) > 1 else Estimate(values[0])
