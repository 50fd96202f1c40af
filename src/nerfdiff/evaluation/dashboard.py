"""TensorBoard for evaluate.py and distill.py: a run for every row of results."""

import csv
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import zip_longest
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from nerfdiff.distill.trace import TRACE, Step
from nerfdiff.metrics.predictions import read_plan
from nerfdiff.metrics.table import METRICS, Metric, named
from nerfdiff.results import tensorboard
from nerfdiff.results.row import ResultRow, flatten
from nerfdiff.results.tensorboard import Layout
from nerfdiff.utils.hashes import sha256_values

log = logging.getLogger(__name__)

FOLDER = "tensorboard"
CURVES = "curves"
SETTINGS = (
    *("strategy", "dataset", "model", "field", "weights", "prior", "K", "samples_per_ray", "precision", "backend"),
    *("compile", "scenes_at_once", "seed", "device"),
)
PARTS = ("encode_s", "denoise_s", "fit_s", "guide_s", "render_s")
PER_SCENE = ("denoiser_calls", "field_queries", "field_bytes")


@dataclass(frozen=True)
class Dashboard:
    """Write `tensorboard/` beside the file of results.

    A row's run holds its settings, metrics and costs, text and contact sheet. Its curves, over the steps of
    distillation and over the scenes, are a run of `curves/`: all scalars of the first are columns of the HPARAMS tab.

    Args:
        ignored: overrides that tell no runs apart, or what they begin with.
        layout: of the custom scalars tab, beside the metrics (`accuracy_layout`).
    """

    ignored: Sequence[str]
    layout: Layout

    def write(self, cfg: DictConfig, row: ResultRow, sheet: Path | None) -> None:
        """Write the run of one row, in place of an earlier one of this name.

        Args:
            cfg: of the command.
            sheet: PNG of the row's pictures.
        """
        home = Path(cfg.results).parent
        name, hparams = _name(row), _hparams(row, self.ignored)
        facts = {"status": row.status, "error": row.error, **hparams, **_metrics(row)}
        settings = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
        texts = {
            "about": f"{tensorboard.code(row.command or '')}\n\n{tensorboard.table(facts)}",
            "config": tensorboard.code(OmegaConf.to_yaml(settings, resolve=HydraConfig.initialized()), "yaml"),
        }
        with _fresh(home / FOLDER / name) as writer:
            tensorboard.begin(writer, hparams, texts, accuracy_layout() | self.layout)
            for tag, value in _metrics(row).items():
                writer.add_scalar(tag, value, 0)
            if sheet is not None:
                writer.add_image("pictures", np.asarray(Image.open(sheet)), 0, dataformats="HWC")
            tensorboard.end(writer, row.status == "ok")
        curves = {} if row.status != "ok" else _traces(home, row) | _scenes(home, row)
        if curves:
            with _fresh(home / FOLDER / CURVES / name) as writer:
                for tag, values in curves.items():
                    for step, value in enumerate(values):
                        if value is not None and math.isfinite(value):
                            writer.add_scalar(tag, value, step)


def accuracy_layout() -> Layout:
    """Charts of the metrics that are compared, of each scene too, and of those that a run has one number of."""
    shown = [metric for metric in METRICS.values() if metric.compared or metric.per == "run"]
    charts = {", ".join(filter(None, (metric.label, metric.unit))): [_tag(metric)] for metric in shown}
    scenes = {f"{m.label} of each scene": [f"scenes/{m.name}"] for m in shown if m.per != "run"}
    return {"Accuracy": charts | scenes}


def _tag(metric: Metric) -> str:
    return f"{'details' if metric.detail else 'accuracy'}/{metric.name}"


def show_in_dashboard(cfg: DictConfig, rows: Sequence[ResultRow], sheet: Path | None = None) -> None:
    """Write `cfg.dashboard`, if there is to be one; where it cannot be written, the rows are what counts.

    Args:
        rows: of one command; the sheet shows them all, and stands with the first.
    """
    if cfg.dashboard is None:
        return
    dashboard = instantiate(cfg.dashboard, _convert_="all")
    try:
        for number, row in enumerate(rows):
            dashboard.write(cfg, row, sheet if number == 0 else None)
    except OSError as error:
        log.warning("TensorBoard's files cannot be written: %s", error)


def _name(row: ResultRow) -> str:
    """Name a row's run by the folder of its predictions and, as several strategies may lie there, its strategy."""
    if row.folder is None:
        return f"failed/{row.strategy}-{sha256_values(row.overrides)[:8]}"
    folder = Path(*(part for part in Path(row.folder).parts if part != ".."))
    return str(folder if folder.name.startswith(f"{row.strategy}-") else folder / row.strategy)


def _hparams(row: ResultRow, ignored: Sequence[str]) -> dict[str, Any]:
    settings = {name: getattr(row, name) for name in SETTINGS}
    given = tensorboard.overridden(row.overrides or (), ignored)
    return settings | {key: value for key, value in given.items() if settings.get(key) is None}


def _metrics(row: ResultRow) -> dict[str, float]:
    """Return a row's measured numbers by tag.

    TensorBoard sorts tags by name, and its HPARAMS tab shows the first few until asked for more.
    """
    flat, scenes = flatten(row), row.n_scenes or 1
    values = {_tag(metric): row.measured(metric.name) for metric in METRICS.values()}
    values |= {"cost/scene_s": flat["scene_s_median"]}
    values |= {f"counts/{name}": None if flat[name] is None else flat[name] / scenes for name in PER_SCENE}
    values |= {f"counts/{name}": flat[name] for name in ("params", "peak_mem_bytes", "fallbacks")}
    values |= {f"parts/{name}": flat[f"{name}_median"] for name in PARTS}
    return {tag: float(value) for tag, value in values.items() if value is not None and math.isfinite(value)}


def _traces(home: Path, row: ResultRow) -> dict[str, list[float | None]]:
    """Read the traces of distillation, where there are any: means over scenes, by step."""
    folder = home / row.folder / "predictions" / row.strategy
    scenes = [_read(folder / scene / TRACE) for scene in read_plan(folder)["scenes"]]
    steps = list(zip_longest(*filter(None, scenes), fillvalue={}))  # a scene that failed has fewer
    return {f"distill/{field.name}": [_mean(step, field.name) for step in steps] for field in fields(Step) if steps}


def _scenes(home: Path, row: ResultRow) -> dict[str, list[float | None]]:
    """Read the metrics of each scene, in the order of the scenes."""
    scenes = _read(home / row.folder / "scores" / row.strategy / "per_scene.csv")
    return {f"scenes/{name}": [_mean([scene], name) for scene in scenes] for name in named("image", "scene")}


def _mean(lines: Sequence[Mapping[str, str]], column: str) -> float | None:
    """Return the mean of the cells that hold finite numbers."""
    cells = [float(line[column]) for line in lines if line.get(column)]
    cells = [value for value in cells if math.isfinite(value)]
    return fmean(cells) if cells else None


def _read(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@contextmanager
def _fresh(folder: Path) -> Iterator[SummaryWriter]:
    """Open a writer into `folder`, and remove its earlier event files afterwards."""
    before = list(folder.glob("events.*"))
    with SummaryWriter(str(folder)) as writer:
        yield writer
    for path in before:
        path.unlink(missing_ok=True)
