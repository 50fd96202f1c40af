"""What each scene was given: against how hard it is, and against the fixed budget that suits it best."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from nerfdiff.metrics.summary import read_cells
from nerfdiff.metrics.table import METRICS
from nerfdiff.results.frame import Run
from nerfdiff.results.text import markdown_lines, write_csv
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import write_text

BASE = "none"
"""The strategy whose PSNR says how hard a scene is."""
SPENT = ("seconds", "denoiser_calls", "field_queries", "steps")
STATED = ("budget=adaptive", "quality=good", "quality=draft", "seconds_per_scene=")
"""How overrides begin by which a scene is given what it needs, or what there is time for."""


@dataclass(frozen=True)
class Spent:
    """What one run spent on one scene.

    Args:
        configuration: the run's strategy and overrides, without the seed.
        base_psnr: of the single-image NeRF, in dB: the lower, the harder the scene. None: there is no such run.
        quality: of the scene by the metric asked for.
        seconds: of its distillation.
        stopped_by: why the distillation ended.
    """

    configuration: str
    seed: int | None
    scene: str
    base_psnr: float | None
    quality: float | None
    seconds: float | None
    denoiser_calls: float | None
    field_queries: float | None
    steps: float | None
    stopped_by: str | None


@dataclass(frozen=True)
class Correlation:
    """Spearman's of what scenes were given with how hard they are; None where all are alike, or too few.

    Args:
        n: scenes, each with the mean over its seeds.
        p: of there being none, by the t distribution.
    """

    configuration: str
    spent: str
    n: int
    rho: float | None
    p: float | None


@dataclass(frozen=True)
class Regret:
    """How much a scene lost to its own best fixed budget: the cheapest that is within `tolerance` of the best quality.

    Args:
        best: that budget's configuration.
        quality: how much better it is, in the metric's unit; positive is a loss.
        seconds: how much cheaper it is; positive is a loss.
    """

    configuration: str
    seed: int | None
    scene: str
    best: str
    quality: float
    seconds: float


def is_stated(run: Run) -> bool:
    """Return true for runs whose scenes were given what they need, or what there was time for."""
    return any(word.lstrip("+").startswith(STATED) for word in run.row.overrides or ())


def spending(runs: Sequence[Run], metric: str = "psnr") -> list[Spent]:
    """Return what runs that distilled spent on each scene. Runs without scores are left out.

    Args:
        runs: those of `BASE` say how hard the scenes of the same split and model are.
        metric: of a scene's quality.

    Raises:
        ConfigError: there is no such metric of scenes.
        DataError: scores are damaged.
    """
    if metric not in METRICS or METRICS[metric].per == "run":
        raise ConfigError(f"metric={metric!r} has no value per scene; choose another, as psnr")
    read = [(run, cells) for run in runs if run.row.status == "ok" and (cells := _cells(run)) is not None]
    hardness = {
        (_data(run), scene): _number(cells, "psnr")
        for run, scenes in read
        if run.row.strategy == BASE
        for scene, cells in scenes.items()
    }
    return [
        Spent(
            _name(run),
            run.row.seed,
            scene,
            hardness.get((_data(run), scene)),
            _number(cells, metric),
            _number(cells, "distill"),
            *(_number(cells, name) for name in SPENT[1:]),
            cells.get("stopped_by"),
        )
        for run, scenes in read
        if run.row.denoiser_calls
        for scene, cells in scenes.items()
    ]


def correlations(spent: Sequence[Spent], name: str = "seconds") -> list[Correlation]:
    """Return per configuration how what scenes were given (`name`) follows how hard they are.

    1 is in the same order: the lower the PSNR of the single-image NeRF, the more was spent.
    """
    found = []
    for configuration in dict.fromkeys(line.configuration for line in spent):
        own: dict[str, list[tuple[float, float]]] = {}
        for line in spent:
            value = getattr(line, name)
            if line.configuration == configuration and None not in (value, line.base_psnr):
                own.setdefault(line.scene, []).append((-line.base_psnr, value))
        points = np.array([np.mean(seeds, axis=0) for seeds in own.values()]).reshape(-1, 2)
        varied = len(points) > 2 and np.ptp(points, axis=0).min() > 0
        rho, p = map(float, spearmanr(*points.T)) if varied else (None, None)
        found.append(Correlation(configuration, name, len(points), rho, p))
    return found


def regrets(
    spent: Sequence[Spent], stated: Callable[[str], bool], metric: str = "psnr", tolerance: float = 0.05
) -> list[Regret]:
    """Return how much each scene of stated runs lost to the fixed budget that would have suited it best.

    Args:
        spent: of stated runs and of runs with fixed budgets, of one strategy and seed or of several: only like is
            compared with like.
        stated: tells by a configuration's name whether it is one of those.
        metric: that `spent` has as quality.
        tolerance: in its unit, within which a cheaper budget is as good.
    """
    sign = METRICS[metric].sign
    lines = [line for line in spent if None not in (line.quality, line.seconds)]
    fixed: dict[tuple, list[Spent]] = {}
    for line in lines:
        if not stated(line.configuration):
            fixed.setdefault((_strategy(line), line.seed, line.scene), []).append(line)
    found = []
    for line in lines:
        others = fixed.get((_strategy(line), line.seed, line.scene), []) if stated(line.configuration) else []
        if others:
            top = max(sign * other.quality for other in others)
            best = min(
                (other for other in others if sign * other.quality >= top - tolerance),
                key=lambda other: (other.seconds, -sign * other.quality),
            )
            lost = sign * (best.quality - line.quality), line.seconds - best.seconds
            found.append(Regret(line.configuration, line.seed, line.scene, best.configuration, *lost))
    return found


def write_spending(folder: Path, runs: Sequence[Run], metric: str = "psnr", tolerance: float = 0.05) -> Path:
    """Write spending.csv, a line per run and scene, regret.csv, and spending.md, which has what they say; return that.

    Raises:
        ConfigError, DataError: see `spending`.
    """
    spent = spending(runs, metric)
    names = {_name(run) for run in runs if is_stated(run)}
    lost = regrets(spent, names.__contains__, metric, tolerance)
    for name, kind, lines in (("spending", Spent, spent), ("regret", Regret, lost)):
        write_csv(folder / f"{name}.csv", [field.name for field in fields(kind)], map(asdict, lines))
    path = folder / "spending.md"
    write_text(path, markdown(spent, lost, metric))
    return path


def markdown(spent: Sequence[Spent], lost: Sequence[Regret], metric: str) -> str:
    """Return per configuration what scenes were given, how that follows how hard they are, and what was lost."""
    rows = [["configuration", "scenes", "seconds, least", "median", "most", "Spearman", "p", "ended by"]]
    for line in correlations(spent):
        own = [one for one in spent if one.configuration == line.configuration]
        seconds = [one.seconds for one in own if one.seconds is not None] or [math.nan]
        reasons = [one.stopped_by for one in own if one.stopped_by]
        ended = ", ".join(f"{why} {reasons.count(why)}" for why in sorted(set(reasons))) or "–"
        spread = [f"{value:.1f}" for value in (min(seconds), float(np.median(seconds)), max(seconds))]
        rows.append([line.configuration, str(line.n), *spread, _shown(line.rho), _shown(line.p), ended])
    text = (
        "Seconds of distillation per scene. Spearman: with how hard a scene is (PSNR of the single-image NeRF, the "
        "lowest being the hardest).\n\n" + markdown_lines(rows)
    )
    if lost:
        rows = [["configuration", "scenes", f"{METRICS[metric].heading} lost", "most", "seconds lost", "most"]]
        for name in dict.fromkeys(line.configuration for line in lost):
            own = [line for line in lost if line.configuration == name]
            values = [[getattr(line, of) for line in own] for of in ("quality", "seconds")]
            rows.append([name, str(len(own)), *(f"{of(v):+.2f}" for v in values for of in (np.mean, max))])
        text += "\nAgainst each scene's own best fixed budget (positive is a loss).\n\n" + markdown_lines(rows)
    return text


def _cells(run: Run) -> Mapping[str, Mapping[str, str]] | None:
    path = run.file("scores", str(run.row.strategy), "per_scene.csv")
    return None if path is None else read_cells(path)


def _number(cells: Mapping[str, str], name: str) -> float | None:
    return float(cells[name]) if name in cells else None


def _data(run: Run) -> tuple:
    return run.row.split_sha256, run.row.ckpt_sha256, run.row.stress, run.row.severity


def _name(run: Run) -> str:
    words = [word for word in run.settings if not word.lstrip("+").startswith("strategy=")]
    return " ".join([str(run.row.strategy), *words])


def _strategy(line: Spent) -> str:
    return line.configuration.partition(" ")[0]


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
