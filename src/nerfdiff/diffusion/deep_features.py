"""Reuse of a U-Net's deep levels between neighbouring diffusion steps (DeepCache, Ma et al. 2024, arXiv 2312.00858)."""

from dataclasses import dataclass

from torch import Tensor

from nerfdiff.utils.errors import ConfigError


@dataclass(frozen=True)
class DeepReuse:
    """Settings of the reuse of deep levels.

    From one diffusion step to the next, coarse features change little and fine ones much. So all but the first levels
    may run at every `every`-th step only, and in between their last output is reused. It
    is an approximation, and only for steps that follow each other along one reverse process.

    Args:
        every: 1 computes them at each step, which is exact.
        below: resolutions that are computed at each step, counted from the input's.

    Raises:
        ConfigError: either is not positive.
    """

    every: int
    below: int

    def __post_init__(self):
        if self.every < 1 or self.below < 1:
            raise ConfigError(f"deep.every={self.every} and deep.below={self.below} must be at least 1")


class DeepFeatures:
    """The last output of the deep levels, along one reverse process.

    Args:
        reuse: how often that is.
    """

    def __init__(self, reuse: DeepReuse):
        self.reuse = reuse
        self.due = True
        self.last: Tensor | None = None
        self._calls = 0

    def advance(self) -> None:
        """Begin a call of the U-Net: decide if its deep levels are `due`, or their `last` output is reused.

        The U-Net does not count itself: it would be compiled anew for every number of calls.
        """
        self.due = self._calls % self.reuse.every == 0
        self._calls += 1
