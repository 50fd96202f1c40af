"""Proposals of configurations to try: all of them, or some drawn at random."""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from nerfdiff.results.row import ResultRow
from nerfdiff.sweeps.space import Configuration, Space
from nerfdiff.utils.errors import ConfigError

Tried = Mapping[Configuration, Sequence[ResultRow]]
"""The newest row of each seed with which a configuration was run."""


@runtime_checkable
class Proposals(Protocol):
    """Names the configurations of a sweep, those that have been tried before among them."""

    def known(self, space: Space, tried: Tried) -> list[Configuration]:
        """List configurations to try whatever comes of them, in this order."""

    def more(self, space: Space, tried: Tried, size: int) -> list[Configuration]:
        """At most `size` others, now that the known ones have been `tried`; none at the end."""


@dataclass(frozen=True)
class Grid:
    """Every configuration."""

    def known(self, space: Space, tried: Tried) -> list[Configuration]:
        return list(space)

    def more(self, space: Space, tried: Tried, size: int) -> list[Configuration]:
        return []


@dataclass(frozen=True)
class Random:
    """Some configurations, each once, every combination of config groups being as probable.

    Args:
        configurations: how many. The first n are the same for any larger number.
        seed: of the draws.

    Raises:
        ConfigError: there is nothing to draw.
    """

    configurations: int
    seed: int

    def __post_init__(self):
        if self.configurations < 1:
            raise ConfigError(f"hydra.sweeper.proposals.configurations={self.configurations} must be at least 1")

    def known(self, space: Space, tried: Tried) -> list[Configuration]:
        rng = random.Random(self.seed)
        drawn: dict[Configuration, None] = {}
        while len(drawn) < min(self.configurations, len(space)):
            drawn.setdefault(space.draw(rng))
        return list(drawn)

    def more(self, space: Space, tried: Tried, size: int) -> list[Configuration]:
        return []
