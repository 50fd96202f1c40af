"""Result rows as pandas tables: one line per run, or one per configuration with means and intervals."""

import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from nerfdiff.metrics.summary import read_scores
from nerfdiff.metrics.table import METRICS, named
from nerfdiff.results.inside import inside
from nerfdiff.results.intervals import Bootstrap, Estimate, spread
from nerfdiff.results.paired import SceneValues, over_seeds
from nerfdiff.results.row import RESULTS, ResultRow, RowFile, flatten
from nerfdiff.utils.errors import DataError

log = logging.getLogger(__name__)

TIMINGS = ("scene_s", "distill_s", "denoise_s", "fit_s", "guide_s", "encode_s", "render_s")
COUNTS = ("denoiser_calls", "field_queries", "field_bytes")  # of all scenes of a run; a table has them per scene
SIZES = ("peak_mem_bytes", "params", "timing_s")
COSTS = (*TIMINGS, *COUNTS, *SIZES)
IDENTITY = (
    "dataset", "split_sha256", "n_scenes", "n_views", "image_size", "ckpt_sha256", "weights", "model", "field",
    "strategy", "prior", "K", "samples_per_ray", "backend", "compile", "scenes_at_once", "precision", "device", "cpu",
    "stress", "severity",
)  # fmt: skip

Scores = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Run:
    """A row, the folder of the file that it is from, and the folders of results in which its own may lie."""

    row: ResultRow
    home: Path
    roots: tuple[Path, ...] = ()

    def file(self, *parts: str) -> Path | None:
        """A file or folder below its folder (itself without `parts`); None if it is not there, or outside of `roots`.

        Without `roots` it is to lie within `home`.
        """
        return (
            None if self.row.folder is None else inside(self.roots or (self.home,), self.home, self.row.folder, *parts)
        )

    @property
    def astray(self) -> bool:
        """Return true if it names a folder that is there, and not within the results."""
        return (
            self.row.folder is not None
            and self.file() is None
            and inside((Path("/"),), self.home, self.row.folder) is not None
        )

    @property
    def settings(self) -> tuple[str, ...]:
        """Its overrides, the seed's left out; in any order they say the same."""
        return tuple(sorted(word for word in self.row.overrides or () if word.lstrip("+").partition("=")[0] != "seed"))

    @property
    def device(self) -> str | None:
        """The accelerator, or the model of the processor that did its work; None where it is not known."""
        return self.row.cpu or self.row.device if self.row.device == "cpu" else self.row.device


def find_results(path: str | Path, onerror: Callable[[OSError], object] | None = None) -> list[Path]:
    """The files of results at or below a path, in order.

    Args:
        onerror: is told of folders that cannot be read.

    Raises:
        DataError: there is no such file or folder.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise DataError(f"results={path} does not exist; name a folder of runs or a {RESULTS}")
    found = []
    for folder, below, files in os.walk(path, onerror=onerror):
        below[:] = sorted(set(below) - {"predictions", "scores"})  # of many files, none of them results
        found += [Path(folder, RESULTS)] if RESULTS in files else []
    return found


def read_runs(file: Path | RowFile, roots: tuple[Path, ...] = ()) -> list[Run]:
    """The runs of one file of results, oldest first. Shards of a run are none: merged, they have a row of their own.

    Raises:
        DataError: see `RowFile.read`.
    """
    file = file if isinstance(file, RowFile) else RowFile(file)
    rows = file.read()
    whole = [Run(row, file.path.parent, roots) for row in rows if row.shard is None]
    if len(whole) < len(rows):
        log.info("%s: %d rows are of shards, and left out", file.path, len(rows) - len(whole))
    return whole


def newest(runs: Sequence[Run]) -> list[Run]:
    """The runs, oldest first, without those that were run again or stand in several files.

    One that succeeded gives way to a later one that differs in nothing, wherever either lies. One that failed gives way
    to any later attempt with the same overrides on its device, or on any where it failed before it had one: it may have
    seen too little to know more. But a later failure hides no success.
    """
    kept: dict[tuple, Run] = {}
    for run in sorted(runs, key=lambda run: run.row.time):
        attempt = (_attempt(run), run.row.seed, run.row.overrides is None and run.row.run_id)
        for device in {run.device, None}:
            kept.pop((attempt, device), None)
        succeeded = run.row.status == "ok"
        key = (_identity(run), run.row.seed) if succeeded else (attempt, run.device)
        kept.pop(key, None)
        kept[key] = run
    return list(kept.values())


def run_lines(runs: Iterable[Run]) -> Iterator[dict[str, object]]:
    """One line per run: `results`, the folder of its file, and all fields of its row flattened."""
    return ({"results": str(run.home)} | flatten(run.row) for run in runs)


def runs_frame(runs: Sequence[Run]) -> pd.DataFrame:
    """`run_lines` as a table."""
    return pd.DataFrame(run_lines(runs))


@dataclass(frozen=True)
class Configuration:
    """Runs that agree in everything but their seed, and succeeded.

    Args:
        failed: how many more of them there are that did not, on its device or before they had one.
        estimates: of what was measured (`METRICS` and `COSTS`), by the names of `ResultRow`. Qualities with values
            per scene: the mean over seeds and scenes and its bootstrap interval. Other qualities: the mean over
            seeds and their range. Timings: the mean over seeds of the medians, and of median ± half the interquartile
            range the lowest and the highest of any seed. Counts (per scene) and sizes: the mean over seeds and their
            range.
        scenes: of the qualities that have them, the values of every scene: the means over seeds.
    """

    runs: tuple[Run, ...]
    failed: int
    estimates: dict[str, Estimate]
    scenes: dict[str, SceneValues] = field(default_factory=dict)

    @property
    def row(self) -> ResultRow:
        """Row of its first seed."""
        return self.runs[0].row

    @property
    def settings(self) -> tuple[str, ...]:
        return self.runs[0].settings

    @property
    def seeds(self) -> list[int | None]:
        return [run.row.seed for run in self.runs]


def configurations(
    runs: Sequence[Run], bootstrap: Bootstrap, warn: Callable[[str], object] = log.warning
) -> list[Configuration]:
    """The configurations of which a run succeeded, in the order of their first such run; see `newest` for what counts.

    Args:
        warn: is told of damaged files of scores, which are as good as none.
    """
    groups: dict[str, list[Run]] = {}
    failures: dict[tuple, int] = {}
    for run in newest(runs):
        if run.row.status == "ok":
            groups.setdefault(_identity(run), []).append(run)
        else:
            key = (_attempt(run), run.device)
            failures[key] = failures.get(key, 0) + 1
    found = []
    for members in groups.values():
        attempt, devices = _attempt(members[0]), {members[0].device, None}
        failed = sum(failures.get((attempt, device), 0) for device in devices)
        scores = [_read_scenes(run, warn) for run in members]
        estimates = _estimates(members, scores, bootstrap)
        found.append(Configuration(tuple(members), failed, estimates, over_seeds(scores)))
    return found


def configurations_frame(found: Sequence[Configuration]) -> pd.DataFrame:
    """One line per configuration, see `configuration_line`."""
    return pd.DataFrame([configuration_line(configuration) for configuration in found])


def configuration_columns() -> list[str]:
    """The names that `configuration_line` gives."""
    measured = [f"{name}{end}" for name in (*METRICS, *COSTS) for end in ("", "_low", "_high")]
    return [*IDENTITY, "seeds", "failed", "fallbacks", *measured, "overrides", "results"]


def configuration_line(configuration: Configuration) -> dict[str, object]:
    """Return a table's line: identity, then `<name>`, `<name>_low` and `<name>_high` of each estimate."""
    row = configuration.row
    line: dict[str, object] = dict.fromkeys(configuration_columns())
    line |= {name: getattr(row, name) for name in IDENTITY}
    line["image_size"] = "x".join(map(str, row.image_size or ())) or None
    line |= {
        "seeds": " ".join(map(str, configuration.seeds)),
        "failed": configuration.failed,
        "fallbacks": sum(run.row.fallbacks or 0 for run in configuration.runs),
    }
    for name, (mean, low, high) in configuration.estimates.items():
        line |= {name: mean, f"{name}_low": low, f"{name}_high": high}
    return line | {"overrides": " ".join(configuration.settings), "results": str(configuration.runs[0].home)}


def _identity(run: Run) -> str:
    known = [getattr(run.row, name) for name in IDENTITY]
    return json.dumps([known, run.settings, run.row.overrides is None and run.row.run_id])


def _attempt(run: Run) -> tuple:
    """Return the facts known from a run's start, however early it failed; its device may be unknown."""
    return run.settings, run.row.strategy


def _estimates(runs: Sequence[Run], scores: Sequence[Scores], bootstrap: Bootstrap) -> dict[str, Estimate]:
    found = {}
    for name in (*METRICS, *COUNTS, *SIZES):
        values = [value for run in runs if (value := _value(run.row, name)) is not None]
        if len(values) == len(runs):
            found[name] = spread(values)
    for name in TIMINGS:
        timings = [timing for run in runs if (timing := getattr(run.row, name)) is not None]
        if len(timings) == len(runs):
            medians, halves = [float(t["median"]) for t in timings], [t["iqr"] / 2 for t in timings]
            ends = [(median - half, median + half) for median, half in zip(medians, halves, strict=True)]
            found[name] = Estimate(
                float(np.mean(medians)), max(0.0, min(low for low, _ in ends)), max(high for _, high in ends)
            )
    names, values = _per_scene(scores)
    return found | dict(zip(names, bootstrap.over_seeds_and_scenes(values) if names else (), strict=True))


def _value(row: ResultRow, name: str) -> float | None:
    value = row.measured(name)
    if value is None or (name in COUNTS and not row.n_scenes):
        return None
    return value / row.n_scenes if name in COUNTS else float(value)


def _per_scene(scores: Sequence[Scores]) -> tuple[list[str], np.ndarray]:
    """Names of metrics, and their values (metrics, seeds, scenes) where every scene of every seed has one."""
    scenes = sorted(set.intersection(*map(set, scores)))
    per_scene = named("image", "scene")
    names = [name for name in per_scene if scenes and all(name in seed[scene] for seed in scores for scene in scenes)]
    values = [[[seed[scene][name] for scene in scenes] for seed in scores] for name in names]
    return names, np.array(values, dtype=np.float64)


def _read_scenes(run: Run, warn: Callable[[str], object]) -> Scores:
    """Read the scores of each scene; empty where they are no longer beside the results."""
    path = run.file("scores", str(run.row.strategy), "per_scene.csv")
    if path is None:
        return {}
    try:
        return read_scores(path)
    except DataError as error:
        warn(f"{error}; the means are of its row, without intervals over scenes")
        return {}
