"""Frontier of a sweep's lines: those that nothing else beats."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfdiff.metrics.table import METRICS
from nerfdiff.results.frontier import frontier
from nerfdiff.sweeps.jobs import Group
from nerfdiff.sweeps.lines import Line
from nerfdiff.utils.errors import ConfigError


@dataclass(frozen=True)
class Frontier:
    """Marks the lines on the Pareto frontier of a cost and each of some qualities, by the names of `ResultRow`.

    Args:
        cost: what is paid.
        qualities: metrics; None: all that are `compared`.

    Raises:
        ConfigError: there is no such metric.
    """

    cost: str
    qualities: Sequence[str] | None

    def __post_init__(self):
        if unknown := [name for name in self.qualities or () if name not in METRICS]:
            raise ConfigError(f"table.frontier.qualities: {unknown[0]} is no metric; choose {', '.join(METRICS)}")

    def __call__(self, groups: Sequence[Group], lines: Sequence[Line]) -> list[Line]:
        """The lines, each with the qualities in which it is on the frontier of those from its device."""
        devices = [tuple({(job.row.device, job.row.cpu) for job in group.succeeded}) for group in groups]
        marks: list[list[str]] = [[] for _ in lines]
        compared = [name for name, metric in METRICS.items() if metric.compared]
        for quality in compared if self.qualities is None else self.qualities:
            for device in dict.fromkeys(devices):
                measured = [
                    number
                    for number, line in enumerate(lines)
                    if devices[number] == device and {self.cost, quality} <= line.metrics.keys()
                ]
                cost = np.array([lines[number].metrics[self.cost].mean for number in measured])
                value = np.array([lines[number].metrics[quality].mean for number in measured]) * METRICS[quality].sign
                for kept in frontier(cost, value):
                    marks[measured[kept]].append(quality)
        return [replace(line, frontier=tuple(mark)) for line, mark in zip(lines, marks, strict=True)]
