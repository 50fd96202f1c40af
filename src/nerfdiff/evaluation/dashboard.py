"""TensorBoard for evaluate.py, distill.py and picture.py: a run for every row of results, and for every picture."""

import csv
import logging
import math
import re
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
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import write_text
from nerfdiff.utils.hashes import sha256_values

log = logging.getLogger(__name__)

FOLDER = "tensorboard"
OF = "of.txt"
"""In a run's folder: where its predictions lie, so that others of the same words get another name."""
LONGEST = 100
"""Characters of a run's name, after which a digest stands for the rest."""
SETTINGS = (
    *("strategy", "dataset", "model", "field", "weights", "prior", "K", "samples_per_ray", "precision", "backend"),
    *("compile", "scenes_at_once", "seed", "device"),
)
PARTS = ("encode_s", "denoise_s", "fit_s", "guide_s", "render_s")
PER_SCENE = ("denoiser_calls", "field_queries", "field_bytes")


@dataclass(frozen=True)
class Dashboard:
    """Write `tensorboard/` beside the file of results.

    A row's run is called after its strategy and what else the command set. It holds settings, metrics and costs, text,
    contact sheet, and curves over the steps of distillation and over the scenes. TensorBoard sorts tags by name: what
    is looked at first begins with `accuracy/`. `kind` tells distillations from trainings in the HPARAMS tab.

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
        hparams = {"kind": "distillation"} | _hparams(row, self.ignored)
        folder = _folder(home / FOLDER, self._name(row), f"{row.folder} {row.strategy}")
        facts = {"status": row.status, "error": row.error, **hparams, **_metrics(row)}
        about = f"{tensorboard.code(row.command or '')}\n\n{tensorboard.table(facts)}"
        curves = {} if row.status != "ok" else _traces(home, row) | _scenes(home, row)
        numbers = {tag: [value] for tag, value in _metrics(row).items()}
        self._write(folder, cfg, hparams, about, numbers | curves, sheet, row.status == "ok")

    def write_picture(
        self, cfg: DictConfig, home: Path, name: str, facts: Mapping[str, Any], sheet: Path | None, trace: Path | None
    ) -> None:
        """Write the run of one picture's scene into `<home>/tensorboard/picture/`, where other views are not known.

        Args:
            name: of the scene.
            facts: what it was made of, and how it went (`status`).
            sheet: PNG of its views.
            trace: CSV of its distillation.
        """
        hparams = {"kind": "picture", "strategy": cfg.strategy.name, "seed": cfg.seed}
        if HydraConfig.initialized():
            given = tensorboard.overridden(HydraConfig.get().overrides.task, [*self.ignored, "images", "image"])
            hparams |= {key: value for key, value in given.items() if key not in hparams}
        folder = _folder(home / FOLDER, _called(f"picture/{name}", {"strategy": cfg.strategy.name}), str(facts))
        about = tensorboard.table(dict(facts))
        self._write(folder, cfg, hparams, about, _curves([_read(trace)] if trace else []), sheet, True)

    def _write(
        self,
        folder: Path,
        cfg: DictConfig,
        hparams: Mapping[str, Any],
        about: str,
        scalars: Mapping[str, Sequence[float | None]],
        sheet: Path | None,
        succeeded: bool,
    ) -> None:
        settings = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
        config = OmegaConf.to_yaml(settings, resolve=HydraConfig.initialized())
        texts = {"about": about, "config": tensorboard.code(config, "yaml")}
        with _fresh(folder) as writer:
            tensorboard.begin(writer, hparams, texts, accuracy_layout() | self.layout)
            for tag, values in scalars.items():
                for step, value in enumerate(values):
                    if value is not None and math.isfinite(value):
                        writer.add_scalar(tag, value, step)
            if sheet is not None:
                writer.add_image(
                    "accuracy/pictures", np.asarray(Image.open(sheet).convert("RGB")), 0, dataformats="HWC"
                )
            tensorboard.end(writer, succeeded)

    def _name(self, row: ResultRow) -> str:
        """Name a row's run by its strategy and what else its command set."""
        given = tensorboard.overridden(row.overrides or (), self.ignored)
        given.pop("strategy", None)
        return ("failed/" if row.folder is None else "") + _called(row.strategy or "unknown", given)


def accuracy_layout() -> Layout:
    """Charts of the metrics that are compared, of each scene too, and of those that a run has one number of."""
    shown = [metric for metric in METRICS.values() if metric.compared or metric.per == "run"]
    charts = {", ".join(filter(None, (metric.label, metric.unit))): [_tag(metric)] for metric in shown}
    scenes = {f"{m.label} of each scene": [f"scenes/{m.name}"] for m in shown if m.per != "run"}
    return {"Accuracy": charts | scenes}


def _tag(metric: Metric) -> str:
    """Return a metric's tag, numbered so that PSNR comes first where TensorBoard sorts."""
    if metric.detail:
        return f"details/{metric.name}"
    shown = [name for name, other in METRICS.items() if not other.detail]
    return f"accuracy/{shown.index(metric.name) + 1}_{metric.name}"


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
    except (OSError, DataError) as error:
        log.warning("TensorBoard's files cannot be written: %s", error)


def show_picture(
    cfg: DictConfig, home: Path, name: str, facts: Mapping[str, Any], sheet: Path | None, trace: Path | None = None
) -> None:
    """Write `cfg.dashboard` for a picture's scene (see `Dashboard.write_picture`), if there is to be one."""
    if cfg.dashboard is None:
        return
    try:
        instantiate(cfg.dashboard, _convert_="all").write_picture(cfg, home, name, facts, sheet, trace)
    except (OSError, DataError) as error:
        log.warning("TensorBoard's files cannot be written: %s", error)


def _called(what: str, given: Mapping[str, str]) -> str:
    """Write settings behind a name: paths by their last part, and a digest for what would be too long."""
    words = [f"{key}={value.rstrip('/').rpartition('/')[2]}" for key, value in given.items()]
    name = " ".join([what, *(re.sub(r"[^\w.,=+\[\]-]+", "_", word) for word in words)])
    return name if len(name) <= LONGEST else f"{name[:LONGEST].rstrip()}… {sha256_values(name)[:8]}"


def _folder(home: Path, name: str, of: str) -> Path:
    """Return the folder of a run; one of the same name that is about something else keeps its own."""
    for folder in (home / name, home / f"{name} {sha256_values(of)[:8]}"):
        known = folder / OF
        if not known.is_file() or known.read_text(encoding="utf-8") == of:
            break
    write_text(known, of)
    return folder


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
    return _curves([_read(folder / scene / TRACE) for scene in read_plan(folder)["scenes"]])


def _curves(scenes: Sequence[Sequence[Mapping[str, str]]]) -> dict[str, list[float | None]]:
    """Return means over scenes' traces, by step."""
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
