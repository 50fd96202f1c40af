"""From numbers of images and scenes to one number: mean over a scene's images, then mean over scenes."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

from nerfdiff.metrics.table import METRICS, PACKAGE, named
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic

FACTS = ("scene", "views", "status", "verdict", "blank", "stopped_by")  # of a scene, beside its metrics
SPENT = ("distill", "denoiser_calls", "field_queries", "steps")  # on a scene: seconds and counts
LARGEST = 2**21  # bytes of a file of scores: of some 10,000 scenes

Value = float | int | str | None


@dataclass(frozen=True)
class SceneScores:
    """Numbers of one scene.

    Args:
        blank: all target images are white, so there is nothing to predict.
        values: for each metric of images that was measured, one value (or None) per view.
        whole: those of whole scenes that were measured.
        status: `ok`, or why the method fell back to something else.
        verdict: of the judge.
        cost: what was spent, and why no more, as `PredictionWriter` has it.
    """

    scene_id: str
    views: tuple[str, ...]
    blank: bool
    values: Mapping[str, Sequence[float | None]]
    whole: Mapping[str, float | None] = field(default_factory=dict)
    status: str = "ok"
    verdict: str | None = None
    cost: Mapping[str, Value] = field(default_factory=dict)

    def mean(self, metric: str) -> float | None:
        return self.whole.get(metric) if METRICS[metric].per == "scene" else _mean(self.values.get(metric, ()))

    def image_rows(self) -> list[dict[str, Value]]:
        rows = []
        for i, view in enumerate(self.views):
            measured = {m: values[i] for m, values in self.values.items()}
            rows.append({"scene": self.scene_id, "view": view} | measured)
        return rows

    def row(self) -> dict[str, Value]:
        stopped_by = self.cost.get("stopped_by")
        facts = (self.scene_id, len(self.views), self.status, self.verdict, int(self.blank), stopped_by)
        spent = {name: self.cost.get(name) for name in SPENT}
        return dict(zip(FACTS, facts, strict=True)) | spent | {m: self.mean(m) for m in named("image", "scene")}


def summarise(scenes: Sequence[SceneScores]) -> dict[str, Value]:
    """Means over scenes of each metric; None where no image has a value.

    Blank scenes count. Where there are any, `<metric>_without_blank` says what the others alone give.
    """
    views = sum(len(scene.views) for scene in scenes)
    blank = [scene.blank for scene in scenes]
    return summarise_columns(lambda metric: [scene.mean(metric) for scene in scenes], blank, views)


def summarise_columns(
    column: Callable[[str], Sequence[float | None]], blank: Sequence[bool], views: int
) -> dict[str, Value]:
    """As `summarise`.

    Args:
        column: gives a metric's value of each scene.
        blank: of each scene.
        views: of all scenes.
    """
    summary: dict[str, Value] = {"n_scenes": len(blank), "n_views": views, "blank_scenes": sum(blank)}
    for metric in named("image", "scene"):
        values = column(metric)
        summary[metric] = _mean(values)
        if metric == "consistency_psnr":
            summary["consistency_n"] = sum(value is not None for value in values) or None
        if summary["blank_scenes"] and metric in METRICS and METRICS[metric].compared and METRICS[metric] in PACKAGE:
            others = [value for value, white in zip(values, blank, strict=True) if not white]
            summary[f"{metric}_without_blank"] = _mean(others)
    return summary


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Value]]) -> None:
    """Write rows under a header, atomically; what was not measured is an empty cell."""
    with atomic(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: _cell(v) for k, v in row.items()})


def _cell(value: Value) -> Value:
    return f"{value:.8g}" if isinstance(value, float) else value


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of what was measured; NaN if any of it is NaN."""
    known = [v for v in values if v is not None]
    if not known:
        return None
    return math.nan if any(math.isnan(v) for v in known) else fmean(known)


def read_scores(path: Path) -> dict[str, dict[str, float]]:
    """Read the measured values of each scene, by metric.

    Raises:
        DataError: the file is missing or damaged.
    """
    return {
        scene: {name: float(cell) for name, cell in line.items() if name not in (*FACTS, *SPENT)}
        for scene, line in read_cells(path).items()
    }


def read_cells(path: Path) -> dict[str, dict[str, str]]:
    """Read the cells of each scene that are not empty, by column; those beside `FACTS` are numbers.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        if (size := path.stat().st_size) > LARGEST or not path.is_file():
            raise ValueError(f"{size} bytes are too many" if path.is_file() else "no file")
        with open(path, newline="", encoding="utf-8") as file:
            found = {line["scene"]: {k: cell for k, cell in line.items() if cell} for line in csv.DictReader(file)}
        for line in found.values():
            for name in line.keys() - set(FACTS):
                float(line[name])
        return found
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read ({error})") from error
