"""Lines of a sweep's table: one line per group of jobs, over its seeds and scenes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nerfdiff.metrics.summary import read_scores
from nerfdiff.metrics.table import named
from nerfdiff.results.intervals import Bootstrap, Estimate, spread
from nerfdiff.results.paired import difference, in_order, over_seeds
from nerfdiff.results.row import ResultRow
from nerfdiff.sweeps.jobs import Group, Labels, counterpart
from nerfdiff.utils.errors import DataError

TIMINGS = ("distill_s", "scene_s")


@dataclass(frozen=True)
class Line:
    """One line of the table.

    Args:
        metrics: by the names of `ResultRow`. Where there are values per scene: their mean over seeds and scenes and its
            interval. Else: the mean over seeds and its range.
        differences: to the reference, scene by scene.
        closed: how much of a Fréchet distance between the reference and the goal is closed; 1 is all of it.
        paper: its numbers.
        frontier: the qualities in which none that costs less, or as much, is as good.
        status: `ok`, or how many jobs are not.
    """

    labels: Labels
    name: str
    seeds: int
    scenes: int
    status: str
    error: str | None
    fallbacks: int
    metrics: dict[str, Estimate] = field(default_factory=dict)
    differences: dict[str, Estimate] = field(default_factory=dict)
    closed: dict[str, float] = field(default_factory=dict)
    paper: dict[str, float] = field(default_factory=dict)
    frontier: tuple[str, ...] = ()


def lines_of(
    groups: Sequence[Group],
    bootstrap: Bootstrap,
    reference: Mapping[str, str],
    goal: Mapping[str, str],
    paper: Sequence[Mapping[str, Any]],
) -> list[Line]:
    """A line per group.

    Args:
        reference: labels of the group that another is compared with, in place of its own.
        goal: likewise, of the group at which a Fréchet distance is as low as it can get.
        paper: numbers of the paper, each beside the labels `of` the group that they are for.

    A group of which a file of scores is missing or damaged has the means of its rows, and says so as its error.
    """
    values, lost = [], []
    for group in groups:
        try:
            values.append(over_seeds([read_scores(job.own("scores", "per_scene.csv")) for job in group.succeeded]))
            lost.append(None)
        except DataError as error:
            values.append({})
            lost.append(f"{error}; the means are of its rows, without intervals over scenes")
    sets = [_per_run([job.row for job in group.succeeded], (*named("run"), *TIMINGS)) for group in groups]
    lines = []
    for number, (group, scenes, runs) in enumerate(zip(groups, values, sets, strict=True)):
        other, aim = counterpart(group, groups, reference), counterpart(group, groups, goal)
        differences, closed = {}, {}
        if other is not None and other is not group:
            theirs = values[groups.index(other)]
            found = {name: difference(own, theirs.get(name, {}), bootstrap) for name, own in scenes.items()}
            differences = {name: estimate for name, estimate in found.items() if estimate is not None}
            if aim is not None:
                closed = _closed(runs, sets[groups.index(other)], sets[groups.index(aim)])
        lines.append(
            Line(
                labels=group.labels,
                name=group.name,
                seeds=len({job.row.seed for job in group.succeeded}),
                scenes=len(scenes.get("psnr", ())),
                status=_status(group),
                error=_error(group, lost[number]),
                fallbacks=sum(job.row.fallbacks or 0 for job in group.succeeded),
                metrics={metric: bootstrap(in_order(by_scene)) for metric, by_scene in scenes.items()}
                | (_per_run([job.row for job in group.succeeded], named("image", "scene")) if lost[number] else {})
                | runs,
                differences=differences,
                closed=closed,
                paper=next((_numbers(entry) for entry in paper if _same(entry["of"], group.labels)), {}),
            )
        )
    return lines


def _per_run(rows: Sequence[ResultRow], names: Sequence[str]) -> dict[str, Estimate]:
    found = {}
    for name in names:
        values = [value for row in rows if (value := row.measured(name)) is not None]
        if values:
            found[name] = spread([float(value["median"] if isinstance(value, dict) else value) for value in values])
    return found


def _closed(
    runs: Mapping[str, Estimate], start: Mapping[str, Estimate], end: Mapping[str, Estimate]
) -> dict[str, float]:
    closed = {}
    for name in named("run"):
        if name in runs and name in start and name in end and start[name].mean > end[name].mean:
            closed[name] = (start[name].mean - runs[name].mean) / (start[name].mean - end[name].mean)
    return closed


def _status(group: Group) -> str:
    if not group.failed:
        return "ok"
    words = ", ".join(dict.fromkeys(job.status for job in group.failed))
    return words if len(group.failed) == len(group.jobs) else f"{words} ({len(group.failed)} of {len(group.jobs)} jobs)"


def _error(group: Group, lost: str | None) -> str | None:
    """Join the jobs' errors, each once; scenes that fell back in jobs that succeeded count too."""
    said = dict.fromkeys(job.row.error for job in group.jobs if job.row and job.row.error)
    return "; ".join(filter(None, [*said, lost])) or None


def _numbers(entry: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in entry.items() if name != "of"}


def _same(of: Mapping[str, Any], labels: Labels) -> bool:
    return {key: str(value) for key, value in of.items()} == labels
