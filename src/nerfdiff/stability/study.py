"""From the rows of sweep=stability to verdicts: per axis and strategy, over severities."""

import csv
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from omegaconf import DictConfig

from nerfdiff.results.frame import Run
from nerfdiff.results.intervals import Bootstrap
from nerfdiff.stability.breaking import (
    Breaking,
    Judged,
    Outcome,
    Outcomes,
    Point,
    Rules,
    area,
    breaking_point,
    point_of,
    sides_of,
)

log = logging.getLogger(__name__)

SWEPT = ("stress", "stress.severity", "strategy", "seed")
PLACES = ("paths.runs_dir", "paths.output_dir", "run_name", "results", "threads", "data.cache_dir", "data.num_workers")
"""Overrides that say where runs were made, and not what."""
BASELINES = ("copy_input", "mean_image")
CLEAN = "none"


@dataclass(frozen=True)
class Verdict:
    """A strategy on an axis.

    Args:
        points: by growing severity, as the axis lists them.
        breaking: one per side.
        area: see `area`.
        runs: of each point, the runs that left it, for pictures.
    """

    axis: str
    strategy: str
    points: tuple[Point, ...]
    breaking: tuple[Breaking, ...]
    area: float | None
    runs: tuple[tuple[Run, ...], ...]

    @property
    def silent(self) -> int:
        return sum(len(point.silent) for point in self.points)

    @property
    def broken(self) -> int:
        return sum(len(point.failures) for point in self.points)


@dataclass(frozen=True)
class Study:
    """All verdicts of runs that agree in everything but stress, severity, strategy and seed.

    Args:
        settings: the overrides in which they agree.
        clean: mean PSNR without stress, by strategy.
        axes: the stresses, as configs, by name.
        clean_runs: those without stress, by strategy.
    """

    settings: tuple[str, ...]
    verdicts: tuple[Verdict, ...]
    clean: Mapping[str, float]
    axes: Mapping[str, DictConfig] = field(default_factory=dict)
    clean_runs: Mapping[str, Sequence[Run]] = field(default_factory=dict)

    @property
    def silent(self) -> int:
        return sum(verdict.silent for verdict in self.verdicts)

    @property
    def silent_lost(self) -> int:
        """Count the silent failures of rule b; the others are of rule c alone."""
        points = (point for verdict in self.verdicts for point in verdict.points)
        return sum("b" in failure.rules for point in points for failure in point.silent)

    @property
    def broken(self) -> int:
        return sum(verdict.broken for verdict in self.verdicts)


def seed_of(run: Run) -> int:
    """Return the seed that a run was asked for: the stress `seed` gives it another."""
    asked = [word.partition("=")[2] for word in run.row.overrides or () if word.startswith("seed=")]
    return int(asked[-1]) if asked and asked[-1].isdecimal() else run.row.seed or 0


def studies(runs: Iterable[Run], axes: Mapping[str, DictConfig], rules: Rules, bootstrap: Bootstrap) -> list[Study]:
    """Judge the runs of sweeps of stresses, which may lie in several folders, as one seed each; others are left out.

    Args:
        runs: oldest first; the newest of the same job counts.
        axes: the stresses of `conf/stress`.
    """
    jobs: dict[tuple, dict[tuple, Run]] = {}
    for run in runs:
        words = run.row.overrides or ()
        rest = tuple(sorted(w for w in words if w.lstrip("+").partition("=")[0] not in (*SWEPT, *PLACES)))
        key = run.row.stress, run.row.severity, run.row.strategy, seed_of(run)
        jobs.setdefault(rest, {})[key] = run
    found = [_study(settings, list(own.values()), axes, rules, bootstrap) for settings, own in jobs.items()]
    return [study for study in found if study.verdicts]


def _study(
    settings: tuple[str, ...], runs: Sequence[Run], axes: Mapping[str, DictConfig], rules: Rules, bootstrap: Bootstrap
) -> Study:
    by_point: dict[tuple[str, float | None, str], list[Run]] = {}
    for run in runs:
        by_point.setdefault((run.row.stress or CLEAN, run.row.severity, str(run.row.strategy)), []).append(run)
    clean_runs = {strategy: own for (axis, _, strategy), own in by_point.items() if axis == CLEAN}
    scenes = sorted({scene for own in clean_runs.values() for run in own for scene in read_scenes(run)})
    outcomes = {point: _outcomes(own, scenes) for point, own in by_point.items()}
    clean = {strategy: outcomes[CLEAN, None, strategy] for strategy in clean_runs}
    baseline = _better({name: clean.get(name, {}) for name in BASELINES})
    verdicts = []
    strategies = list(dict.fromkeys(strategy for _, _, strategy in by_point if strategy not in BASELINES))
    judged: dict[tuple[str, str], dict[float, Judged]] = {}
    for axis in dict.fromkeys(axis for axis, _, _ in by_point if axis in axes):
        for strategy in strategies:
            for severity in (s for a, s, of in by_point if (a, of) == (axis, strategy)):
                others = axes[axis].own_scenes
                own = _better({name: outcomes.get((axis, severity, name), {}) for name in BASELINES})
                none = outcomes.get((axis, severity, "none"), {} if others else clean.get("none", {}))
                judged.setdefault((axis, strategy), {})[severity] = Judged(
                    severity,
                    outcomes[axis, severity, strategy],
                    {} if others else clean.get(strategy, {}),
                    {} if strategy == "none" else none,
                    own if others else baseline,
                    _frechet(by_point[axis, severity, strategy]),
                    [] if others else _frechet(clean_runs.get(strategy, ())),
                    {} if others or strategy == "none" else clean.get("none", {}),
                )
    points = {
        key: {severity: point_of(each, rules, bootstrap) for severity, each in own.items()}
        for key, own in judged.items()
    }
    for (axis, strategy), own in judged.items():
        order = _in_order(axes[axis], own)
        neutral = next((run.row.neutral for s in own for run in by_point[axis, s, strategy]), None)
        sides = sides_of(order, neutral, axes[axis].ordered)
        verdicts.append(
            Verdict(
                axis,
                strategy,
                tuple(points[axis, strategy][severity] for severity in order),
                tuple(
                    breaking_point(side, [own[s] for s in several], rules, bootstrap) for side, several in sides.items()
                ),
                area(list(points[axis, strategy].values()), list(points.get((axis, "none"), {}).values())),
                tuple(tuple(by_point[axis, severity, strategy]) for severity in order),
            )
        )
    means = {
        strategy: sum(o.psnr for o in own.values()) / len(own)
        for strategy, own in clean.items()
        if own and all(math.isfinite(o.psnr) for o in own.values())
    }
    return Study(settings, tuple(verdicts), means, axes, clean_runs)


def _better(baselines: Mapping[str, Outcomes]) -> dict[str, float]:
    """Return the PSNR of the baseline that is better on average, by scene."""
    means = {
        name: {scene: outcome.psnr for (_, scene), outcome in own.items() if math.isfinite(outcome.psnr)}
        for name, own in baselines.items()
    }
    return max(means.values(), key=lambda own: sum(own.values()) / len(own) if own else -math.inf, default={})


def _in_order(stress: DictConfig, found: Iterable[float]) -> list[float]:
    """Severities by growing number; kinds as their axis lists them."""
    if stress.ordered:
        return sorted(found)
    listed = [float(severity) for severity in stress.severities]
    return sorted(found, key=lambda severity: (listed.index(severity) if severity in listed else 99, severity))


def read_scenes(run: Run) -> dict[str, Outcome]:
    """Read a run's scenes; none where it left no scores."""
    path = run.file("scores", str(run.row.strategy), "per_scene.csv")
    if path is None:
        return {}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return {
                line["scene"]: Outcome(
                    float(line["psnr"]) if line.get("psnr") else math.nan,
                    line["status"] or "error",
                    line.get("verdict") or None,
                )
                for line in csv.DictReader(file)
            }
    except (OSError, ValueError, KeyError, csv.Error) as error:
        log.warning("%s: cannot be read (%s): its scenes count as failed", path, error)
        return {}


def _outcomes(runs: Sequence[Run], scenes: Sequence[str]) -> Outcomes:
    """Scenes of several seeds; those of a run that failed have its status."""
    found: dict[tuple[int, str], Outcome] = {}
    for run in runs:
        own = read_scenes(run)
        if not own:
            status = run.row.status if run.row.status not in ("ok", None) else "error"
            own = {scene: Outcome(math.nan, status) for scene in scenes or ("?",)}
        found |= {(seed_of(run), scene): outcome for scene, outcome in own.items()}
    return found


def _frechet(runs: Sequence[Run]) -> list[float]:
    values = [run.row.fd_st_vgg if run.row.fid is None else run.row.fid for run in runs]
    return [value for value in values if value is not None and math.isfinite(value)]
