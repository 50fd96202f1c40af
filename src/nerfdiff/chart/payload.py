"""Everything that the page shows, as JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfdiff.chart.against import Leads, differences_to, leave_fields, references_of
from nerfdiff.chart.labels import labels_of, names_of
from nerfdiff.chart.panels import Panel, panels_of
from nerfdiff.chart.picks import Picker
from nerfdiff.chart.pictures import links
from nerfdiff.metrics.table import MARK, METRICS
from nerfdiff.results.frame import Configuration, Run, newest
from nerfdiff.results.frontier import frontier
from nerfdiff.results.intervals import Bootstrap, Estimate


@dataclass(frozen=True)
class Measured:
    """Configurations in the page's units, with the frontier of every panel, metric and cost.

    Args:
        labels: per configuration, values of the settings in which those of its panel differ.
        names: per configuration, as few of those settings as tell it from the others of its panel.
        estimates: per configuration, by field.
        frontiers: numbers of configurations by panel, then metric, then cost.
        references: per configuration, the one of the reference strategy that it is compared with.
        differences: per configuration, to its reference, by metric.
        with_field: numbers of those that leave a field, not views alone.
        frontiers_3d: as `frontiers`, of these.
        answers: per panel, for all (`all`) and for these (`3d`): three picks, and per metric the best and its level.
    """

    found: Sequence[Configuration]
    labels: Sequence[dict[str, str]]
    names: Sequence[str]
    panels: Sequence[Panel]
    estimates: Sequence[dict[str, Estimate]]
    frontiers: Sequence[dict[str, dict[str, list[int]]]] = field(default_factory=list)
    references: Sequence[int | None] = ()
    differences: Sequence[dict[str, Estimate]] = ()
    with_field: frozenset[int] = frozenset()
    frontiers_3d: Sequence[dict[str, dict[str, list[int]]]] = ()
    answers: Sequence[dict[str, Any]] = ()

    def points(self, panel: Panel, metric: str, cost: str, only_3d: bool = False) -> list[int]:
        """The panel's configurations that have both."""
        members = self.members(panel, only_3d)
        return [n for n in members if metric in self.estimates[n] and cost in self.estimates[n]]

    def members(self, panel: Panel, only_3d: bool) -> list[int]:
        """Its configurations; with `only_3d` those that leave a field, unless none does."""
        own = [n for n in panel.members if n in self.with_field] if only_3d else []
        return own or list(panel.members)

    def reference(self, panel: Panel) -> int | None:
        """The one that all of the panel that have one are compared with; None if there are several."""
        found = {self.references[n] for n in panel.members} - {None}
        return found.pop() if len(found) == 1 else None


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
    picks: Mapping[str, Any],
    bootstrap: Bootstrap,
) -> Measured:
    """Collect the values to show of `metrics` (see `charted`) and `costs`.

    conf/chart.yaml has the costs, `unnamed` and `picks`.
    """
    scales = {metric["field"]: 1.0 for metric in metrics} | {cost["field"]: cost["scale"] for cost in costs}
    estimates = [_scaled(configuration.estimates, scales) for configuration in found]
    panels = panels_of(found)
    labels: list[dict[str, str]] = [{} for _ in found]
    names = [""] * len(found)
    references: list[int | None] = [None] * len(found)
    solid: set[int] = set()
    for panel in panels:  # what differs within a panel, not what makes it another
        told = labels_of([found[number] for number in panel.members], unnamed)
        for number, own, name in zip(panel.members, told, names_of(told), strict=True):
            labels[number], names[number] = own, name
        for number, reference in references_of(panel.members, found, picks["reference"]).items():
            references[number] = reference
        solid |= {number for number, leaves in leave_fields(panel.members, found).items() if leaves}
    leads = Leads(found, bootstrap, picks["fewest_scenes"])
    compared = [metric["field"] for metric in metrics]
    differences = [
        differences_to(number, reference, estimates, compared, leads) for number, reference in enumerate(references)
    ]
    content = Measured(found, labels, names, panels, estimates, [], references, differences, frozenset(solid))
    return replace(
        content,
        frontiers=[_frontiers(content, panel, metrics, costs, False) for panel in panels],
        frontiers_3d=[_frontiers(content, panel, metrics, costs, True) for panel in panels],
        answers=[_answers(content, panel, compared, costs, picks, leads) for panel in panels],
    )


def _answers(
    content: Measured,
    panel: Panel,
    metrics: Sequence[str],
    costs: Sequence[Mapping[str, Any]],
    picks: Mapping[str, Any],
    leads: Leads,
) -> dict[str, Any]:
    """The panel's picks and, per metric, the best with those that no interval tells from it."""

    def paid(cost: Mapping[str, Any]) -> bool:
        return any(cost["field"] in content.estimates[n] for n in panel.members)

    def by(metric: str, numbers: Sequence[int]) -> int:
        return max(numbers, key=lambda n: METRICS[metric].sign * content.estimates[n][metric].mean)

    ordered = sorted(costs, key=lambda cost: cost["field"] != picks["cost"])
    cost = next(filter(paid, ordered), ordered[0])
    sharpness = [name for name in picks["sharpness"] if any(name in content.estimates[n] for n in panel.members)]
    fidelity = picks["fidelity"]
    nones = {n for n in panel.members if n == content.references[n] and fidelity in content.estimates[n]}
    reference = by(fidelity, sorted(nones)) if nones else None  # of several models', the best
    picker = Picker(content.estimates, content.names, leads, fidelity, next(iter(sharpness), None), cost, reference)
    found = {}
    for key, only_3d in (("all", False), ("3d", True)):
        members = content.members(panel, only_3d)
        level = {}
        for metric in metrics:
            there = [n for n in members if metric in content.estimates[n] and content.found[n].scenes.get(metric)]
            if there:
                best = by(metric, there)
                level[metric] = {"best": best, "level": leads.level_with(metric, best, there)}
        found[key] = {"picks": picker(members), "level": level}
    return found


def _frontiers(
    content: Measured,
    panel: Panel,
    metrics: Sequence[Mapping[str, Any]],
    costs: Sequence[Mapping[str, Any]],
    only_3d: bool,
) -> dict[str, dict[str, list[int]]]:
    return {
        metric["field"]: {
            cost["field"]: _frontier(
                content, content.points(panel, metric["field"], cost["field"], only_3d), metric, cost
            )
            for cost in costs
            if content.points(panel, metric["field"], cost["field"], only_3d)
        }
        for metric in metrics
    }


def _scaled(estimates: Mapping[str, Estimate], scales: Mapping[str, float]) -> dict[str, Estimate]:
    return {
        name: Estimate(*(None if value is None else value * scale for value in estimates[name]))
        for name, scale in scales.items()
        if name in estimates and math.isfinite(estimates[name].mean)
    }


def _frontier(
    content: Measured, points: Sequence[int], metric: Mapping[str, Any], cost: Mapping[str, Any]
) -> list[int]:
    sign = 1 if metric["better"] == "higher" else -1
    costs = np.array([content.estimates[n][cost["field"]].mean for n in points])
    qualities = np.array([sign * content.estimates[n][metric["field"]].mean for n in points])
    return [points[index] for index in frontier(costs, qualities)]


def configuration_values(content: Measured, number: int, page: Path) -> dict[str, Any]:
    """A configuration as the page has it; the words of overrides are numbers, see `Words`."""
    configuration, row = content.found[number], content.found[number].row
    fell_back = [run.row.error for run in configuration.runs if run.row.fallbacks and run.row.error]
    return {
        "name": content.names[number],
        "labels": content.labels[number],
        "strategy": row.strategy or "?",
        "field": row.field,
        "solid": number in content.with_field,
        "reference": content.references[number],
        "differences": {name: _rounded(estimate) for name, estimate in content.differences[number].items()},
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
