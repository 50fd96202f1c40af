"""Which lines of a sweep nothing else beats: as good for less."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfdiff.results.frontier import frontier
from nerfdiff.sweeps.jobs import Group
from nerfdiff.sweeps.lines import Line
from nerfdiff.utils.errors import ConfigError

SIGNS = {"higher": 1.0, "lower": -1.0}


@dataclass(frozen=True)
class Frontier:
    """Marks the lines on the Pareto frontier of a cost and each of some qualities, by the names of `ResultRow`.

    Args:
        cost: what is paid.
        better: `higher` or `lower`, by quality.

    Raises:
        ConfigError: neither of them.
    """

    cost: str
    better: Mapping[str, str]

    def __post_init__(self):
        for name, which in self.better.items():
            if which not in SIGNS:
                raise ConfigError(f"table.frontier.better.{name} takes {' or '.join(SIGNS)}, got {which!r}")

    def __call__(self, groups: Sequence[Group], lines: Sequence[Line]) -> list[Line]:
        """The lines, each with the qualities in which it is on the frontier of those from its device."""
        devices = [tuple({(job.row.device, job.row.cpu) for job in group.succeeded}) for group in groups]
        marks: list[list[str]] = [[] for _ in lines]
        for quality, which in self.better.items():
            for device in dict.fromkeys(devices):
                measured = [
                    number
                    for number, line in enumerate(lines)
                    if devices[number] == device and {self.cost, quality} <= line.metrics.keys()
                ]
                cost = np.array([lines[number].metrics[self.cost].mean for number in measured])
                value = np.array([lines[number].metrics[quality].mean for number in measured]) * SIGNS[which]
                for kept in frontier(cost, value):
                    marks[measured[kept]].append(quality)
        return [replace(line, frontier=tuple(mark)) for line, mark in zip(lines, marks, strict=True)]
