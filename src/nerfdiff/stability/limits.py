"""The judge's limits: found on some axes and scenes, tested on others."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nerfdiff.metrics.predictions import SCENE
from nerfdiff.results.frame import Run
from nerfdiff.stability.breaking import Rules
from nerfdiff.stability.judge import ENDS, LEAST, MOST, OK
from nerfdiff.stability.study import read_scenes
from nerfdiff.stress.axes import stress_files
from nerfdiff.utils.hashes import sha256_values

GAIN = 0.04
"""Share of the broken scenes that a further limit must tell more than: one scene alone is chance."""
Limits = dict[tuple[str, str], float]
"""By sign and `least` or `most`."""


@dataclass(frozen=True)
class Sample:
    """A predicted scene: its signs, whether it is broken by the truth, and whether it fell back: always told."""

    axis: str
    scene: str
    signs: Mapping[str, float]
    broken: bool
    fell_back: bool = False


def suspected(limits: Limits, signs: Mapping[str, float]) -> bool:
    """Return true if a sign is out of its limits, or judged and not finite."""

    def fits(name: str, end: str, limit: float) -> bool:
        value = signs.get(name)
        return value is None or (value >= limit if end == LEAST else value <= limit)

    return not all(fits(name, end, limit) for (name, end), limit in limits.items())


def rates(limits: Limits, samples: Sequence[Sample]) -> tuple[float, float]:
    """Return recall (of the broken, the share that is suspected) and false alarms (of the others, that share)."""
    said = np.array([sample.fell_back or suspected(limits, sample.signs) for sample in samples], dtype=bool)
    broken = np.array([sample.broken for sample in samples], dtype=bool)
    recall = float(said[broken].mean()) if broken.any() else math.nan
    return recall, float(said[~broken].mean()) if (~broken).any() else math.nan


def fit_limits(samples: Sequence[Sample], false_alarms: float, steps: int, margin: float) -> Limits:
    """Add the limit that tells most of the broken scenes which are still untold, while false alarms stay few.

    Args:
        false_alarms: share of sound scenes that may be suspected, over all limits.
        steps: limits at most.
        margin: standard deviations of the sound scenes' signs that a limit is moved away from them.
    """
    broken = np.array([sample.broken for sample in samples], dtype=bool)
    names = sorted({name for sample in samples for name in sample.signs})
    values = {name: np.array([sample.signs.get(name, math.nan) for sample in samples], float) for name in names}
    slack = {name: margin * _spread(values[name][~broken]) for name in names}
    told, limits = np.array([sample.fell_back for sample in samples], dtype=bool), Limits()
    allowed = math.floor(false_alarms * int((~broken).sum()))
    for _ in range(steps):
        best, gain = None, (max(1, round(GAIN * int(broken.sum()))), -len(samples))
        for name in names:
            for end in ENDS[name]:
                for near in _cuts(values[name]):
                    cut = near - slack[name] if end == LEAST else near + slack[name]
                    new = told | (values[name] < cut if end == LEAST else values[name] > cut)
                    alarms = int((new & ~broken).sum())
                    # of equal gains that with fewer false alarms
                    score = int((new & broken).sum()) - int((told & broken).sum()), -alarms
                    if alarms <= allowed and score > gain:
                        best, gain = (name, end, cut, new), score
        if best is None:
            break
        name, end, cut, told = best
        limits[name, end] = float(cut)
    return limits


def _spread(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def _cuts(values: np.ndarray) -> np.ndarray:
    """Candidates between the values, 64 at most."""
    known = np.unique(values[np.isfinite(values)])
    middles = (known[1:] + known[:-1]) / 2
    return middles if len(middles) <= 64 else np.quantile(middles, np.linspace(0, 1, 64))


def halves(samples: Sequence[Sample]) -> tuple[list[Sample], list[Sample]]:
    """Split by axis and by scene: what limits are tested on has neither an axis nor a scene of those before.

    Clean scenes are on the side of their scene.
    """

    def first(name: str) -> bool:
        return int(sha256_values([name])[:8], 16) % 2 == 0

    kept = ([], [])
    for sample in samples:
        sides = {first(sample.scene)} | ({first(sample.axis)} if sample.axis != "none" else set())
        if len(sides) == 1:
            kept[0 if sides.pop() else 1].append(sample)
    return kept


def samples_of(runs: Sequence[Run], rules: Rules) -> list[Sample]:
    """Return the scenes of a sweep's runs that the judge measured; broken are those that fell far under clean ones."""
    clean: dict[tuple, float] = {}
    for run in runs:
        if run.row.stress is None:
            for scene, outcome in read_scenes(run).items():
                clean[run.row.strategy, run.row.seed, scene] = outcome.psnr
    found = []
    axes = stress_files()
    for run in runs:
        if run.row.stress in axes and axes[run.row.stress].own_scenes:
            continue  # of these there is nothing clean to compare with
        for scene, outcome in read_scenes(run).items():
            path = run.file("predictions", str(run.row.strategy), scene, SCENE)
            signs = None if path is None else json.loads(path.read_text(encoding="utf-8")).get("signs")
            if not signs:
                continue
            own = clean.get((run.row.strategy, run.row.seed, scene), math.nan)
            broken = outcome.failed or own - outcome.psnr >= rules.clean
            numbers = {name: float(value) for name, value in signs.items()}
            found.append(Sample(run.row.stress or "none", scene, numbers, bool(broken), outcome.status != OK))
    return found


def limits_text(limits: Limits, fitted_on: Sequence[Sample], tested_on: Sequence[Sample]) -> str:
    """Limits as YAML, and what they tell."""
    lines = []
    for end in (LEAST, MOST):
        own = {name: limit for (name, side), limit in limits.items() if side == end}
        lines += [f"{end}:", *(f"  {name}: {limit:.4g}" for name, limit in own.items())]
    for name, samples in (("fitted", fitted_on), ("tested", tested_on)):
        recall, alarms = rates(limits, samples)
        broken = sum(sample.broken for sample in samples)
        lines.append(
            f"# {name} on {len(samples)} scenes, {broken} broken: recall {recall:.0%}, false alarms {alarms:.0%}"
        )
    return "\n".join(lines)
