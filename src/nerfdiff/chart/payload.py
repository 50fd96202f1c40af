"""Everything that the page shows, as JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfdiff.chart.labels import labels_of, names_of
from nerfdiff.chart.panels import Panel, panels_of
from nerfdiff.chart.pictures import links
from nerfdiff.metrics.table import MARK, METRICS
from nerfdiff.results.frame import Configuration, Run, newest
from nerfdiff.results.frontier import frontier
from nerfdiff.results.intervals import Estimate


@dataclass(frozen=True)
class Measured:
    """Configurations in the page's units, with the frontier of every panel, metric and cost.

    Args:
        labels: per configuration, values of the settings in which those of its panel differ.
        names: per configuration, as few of those settings as tell it from the others of its panel.
        estimates: per configuration, by field.
        frontiers: numbers of configurations by panel, then metric, then cost.
    """

    found: Sequence[Configuration]
    labels: Sequence[dict[str, str]]
    names: Sequence[str]
    panels: Sequence[Panel]
    estimates: Sequence[dict[str, Estimate]]
    frontiers: Sequence[dict[str, dict[str, list[int]]]] = field(default_factory=list)

    def points(self, panel: Panel, metric: str, cost: str) -> list[int]:
        """The panel's configurations that have both."""
        return [n for n in panel.members if metric in self.estimates[n] and cost in self.estimates[n]]


def charted() -> list[dict[str, Any]]:
    """The metrics that the page can show, as it has them; what a cost has too is called the same."""
    return [
        {
            "field": m.name,
            "name": f"{m.label}{MARK if m.rewards else ''}",
            "unit": m.unit,
            "better": m.better,
            "within": m.within,
            "digits": m.digits,
        }
        for m in METRICS.values()
        if m.within is not None
    ]


def measured(
    found: Sequence[Configuration],
    metrics: Sequence[Mapping[str, Any]],
    costs: Sequence[Mapping[str, Any]],
    unnamed: Sequence[str],
) -> Measured:
    """Collect the values to show of `metrics` (see `charted`) and `costs`; conf/chart.yaml has both, and `unnamed`."""
    scales = {metric["field"]: 1.0 for metric in metrics} | {cost["field"]: cost["scale"] for cost in costs}
    estimates = [_scaled(configuration.estimates, scales) for configuration in found]
    panels = panels_of(found)
    labels: list[dict[str, str]] = [{} for _ in found]
    names = [""] * len(found)
    for panel in panels:  # what differs within a panel, not what makes it another
        told = labels_of([found[number] for number in panel.members], unnamed)
        for number, own, name in zip(panel.members, told, names_of(told), strict=True):
            labels[number], names[number] = own, name
    content = Measured(found, labels, names, panels, estimates)
    frontiers = [
        {
            metric["field"]: {
                cost["field"]: _frontier(content, panel, metric, cost["field"])
                for cost in costs
                if content.points(panel, metric["field"], cost["field"])
            }
            for metric in metrics
        }
        for panel in panels
    ]
    return replace(content, frontiers=frontiers)


def _scaled(estimates: Mapping[str, Estimate], scales: Mapping[str, float]) -> dict[str, Estimate]:
    return {
        name: Estimate(*(None if value is None else value * scale for value in estimates[name]))
        for name, scale in scales.items()
        if name in estimates and math.isfinite(estimates[name].mean)
    }


def _frontier(content: Measured, panel: Panel, metric: Mapping[str, Any], cost: str) -> list[int]:
    points = content.points(panel, metric["field"], cost)
    sign = 1 if metric["better"] == "higher" else -1
    costs = np.array([content.estimates[n][cost].mean for n in points])
    qualities = np.array([sign * content.estimates[n][metric["field"]].mean for n in points])
    return [points[index] for index in frontier(costs, qualities)]


def configuration_values(content: Measured, number: int, page: Path) -> dict[str, Any]:
    """A configuration as the page has it; the words of overrides are numbers, see `Words`."""
    configuration, row = content.found[number], content.found[number].row
    fell_back = [run.row.error for run in configuration.runs if run.row.fallbacks and run.row.error]
    return {
        "name": content.names[number],
        "labels": content.labels[number],
        "strategy": row.strategy,
        "overrides": configuration.settings,
        "values": {name: _rounded(estimate) for name, estimate in content.estimates[number].items()},
        "scenes": row.n_scenes,
        "failed": configuration.failed,
        "fell_back": "; ".join(dict.fromkeys(fell_back)) or None,
        "runs": [
            {"seed": run.row.seed, "command": run.row.command, "time": run.row.time, "id": run.row.run_id}
            | links(run, page)
            for run in configuration.runs
        ],
    }


def failure_values(run: Run) -> dict[str, Any]:
    """A run that failed as the page has it."""
    row = run.row
    return {
        "status": row.status,
        "error": row.error,
        "strategy": row.strategy,
        "seed": row.seed,
        "device": run.device,
        "time": row.time,
        "overrides": run.settings,
        "command": row.command,
    }


def failures(runs: Sequence[Run]) -> list[Run]:
    """Those whose newest attempt failed."""
    return [run for run in newest(runs) if run.row.status != "ok"]


def share_words(entries: Sequence[dict[str, Any]]) -> list[str]:
    """Replace the overrides of entries by numbers in the list that is returned: thousands of rows repeat them."""
    numbers: dict[str, int] = {}
    for entry in entries:
        entry["overrides"] = [numbers.setdefault(word, len(numbers)) for word in entry["overrides"]]
    return list(numbers)


def to_json(content: Mapping[str, Any]) -> str:
    """JSON that can stand within a script element."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")  # a tag within a string would end the element


def _rounded(estimate: Estimate) -> list[float | None]:
    values = [None if value is None or not math.isfinite(value) else float(f"{value:.6g}") for value in estimate]
    return values if values[1] is not None and values[2] is not None else values[:1]
