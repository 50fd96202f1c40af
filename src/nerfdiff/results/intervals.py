"""How far a mean over scenes can be trusted: bootstrap intervals over the scenes."""

from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerfdiff.errors import ConfigError


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
        drawn = np.random.default_rng(self.seed).integers(len(values), size=(self.resamples, len(values)))
        tails = (1 - self.level) / 2
        low, high = np.quantile(values[drawn].mean(axis=1), [tails, 1 - tails])
        return Estimate(mean, float(low), float(high))


def spread(values: list[float]) -> Estimate:
    """The mean over runs and their range, where there are several."""
    return Estimate(fmean(values), min(values), max(values)) if len(values) > 1 else Estimate(values[0])
