"""One evaluation: predictions first, scores after, a row of results, pictures."""

import json
import logging
import resource
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader

from nerfdiff.checkpoint import LoadedModel, load_model
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.baselines import CopyInput, MeanImage, mean_training_image
from nerfdiff.distill.strategy import Strategy
from nerfdiff.errors import ConfigError
from nerfdiff.metrics.image import psnr
from nerfdiff.metrics.predictions import SCENE, NonFinitePrediction, PredictionWriter, read_prediction
from nerfdiff.metrics.score import truth_from
from nerfdiff.model import NerfDiff
from nerfdiff.orbit import orbit
from nerfdiff.results.environment import environment
from nerfdiff.results.hashes import sha256_file, sha256_values
from nerfdiff.results.pictures import colour_depth, contact_sheet, orbit_video
from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.results.table import rich_table, write_markdown
from nerfdiff.results.timing import Stopwatch, summarise, time_calls
from nerfdiff.training import auto_precision, plain

log = logging.getLogger(__name__)

PRECISIONS = ("32-true", "bf16-mixed")


@dataclass(frozen=True)
class Subject:
    """What is evaluated on what: everything that predictions of one run share."""

    cfg: DictConfig
    model: NerfDiff
    scenes: DataLoader
    scene_ids: list[str]
    device: torch.device
    precision: str
    identity: dict[str, Any]
    folder: Path

    @property
    def predictions(self) -> Path:
        return self.folder / "predictions"

    def autocast(self):
        """bf16 products where the precision asks for them."""
        if self.precision == "32-true":
            return nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)


def evaluate(cfg: DictConfig) -> list[ResultRow]:
    """Evaluate `cfg.strategy`, and the baselines beside it, on one split of a dataset.

    Leaves in `<cfg.paths.output_dir>/<strategy>-<identity>/`: `predictions/<strategy>/`, `scores/<strategy>/`, a
    contact sheet, an orbit video and a table; appends a row per strategy to `cfg.results`. Scenes already predicted
    by the same model with the same settings on the same files are not predicted again.

    Returns:
        the strategy's row, then the baselines'.

    Raises:
        UserError: bad data, config or checkpoint. A strategy that fails is appended as a row with its status first.
    """
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    device = _device(cfg.device)
    precision = cfg.precision if cfg.precision != "auto" else auto_precision(device.type)
    if precision not in PRECISIONS:
        raise ConfigError(f"precision must be auto, {' or '.join(PRECISIONS)}, got {precision!r}")
    loaded = load_model(cfg.ckpt, cfg.weights, cfg.paths.assets_dir)
    datamodule = instantiate(cfg.data)
    datamodule.setup("test")
    reader = datamodule.reader("test")
    scene_ids = [reader.scene_id(index) for index in datamodule.test_set.indices]
    identity = {
        "ckpt_sha256": sha256_file(loaded.path),
        "weights": loaded.weights,
        "split_sha256": sha256_values(scene_ids),
        "files_sha256": reader.fingerprint(),
        "views": [cfg.data.source_view, cfg.data.eval_stride],
        "image_size": list(next(iter(datamodule.test_dataloader())).source.shape[-2:]),
        "mean_image_scenes": cfg.mean_image_scenes,
        "seed": cfg.seed,
        "precision": precision,
        "strategy": plain(cfg.strategy),
    }
    _check_size(loaded, identity["image_size"])
    folder = Path(cfg.paths.output_dir) / f"{cfg.strategy.name}-{sha256_values(identity)[:8]}"
    model = loaded.model.to(device)
    if cfg.chunk is not None:
        model.renderer = replace(model.renderer, chunk=cfg.chunk)
    subject = Subject(cfg, model, datamodule.test_dataloader(), scene_ids, device, precision, identity, folder)

    strategies: list[Strategy] = [instantiate(cfg.strategy)]
    if cfg.baselines:
        mean = mean_training_image(datamodule.reader("train"), cfg.mean_image_scenes, cfg.seed)
        strategies += [CopyInput(), MeanImage(mean)]
    truth = truth_from(reader)
    scorer = instantiate(cfg.metrics)
    rows = [_measure(subject, strategy, scorer, truth) for strategy in strategies]

    if cfg.sheet.scenes > 0:
        log.info("contact sheet: %s", _sheet(subject, strategies, truth, folder / "sheet.png"))
    if cfg.orbit.scenes > 0:
        log.info("video: %s", _video(subject, strategies[0], folder / "orbit.mp4"))
    write_markdown(folder / "table.md", rows)
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(rich_table(rows, console.width))
    log.info("rows: %s   scores per image and scene: %s", cfg.results, folder / "scores")
    return rows


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter where PyTorch was built without CUDA
        raise ConfigError(
            f"device={name} cannot be used here ({str(error).splitlines()[0]}); try device=auto"
        ) from error
    return device


def _check_size(loaded: LoadedModel, image_size: list[int]) -> None:
    """A model is good at the resolution it was trained at; at another its numbers say little of it."""
    if loaded.image_size is not None and loaded.image_size != image_size:
        raise ConfigError(
            f"{loaded.path} was trained on images of {loaded.image_size}, the data gives {image_size}: "
            f"set data.image_size=[{loaded.image_size[0]},{loaded.image_size[1]}]"
        )


def _measure(subject: Subject, strategy: Strategy, scorer, truth) -> ResultRow:
    """Predict and score with one strategy; its row is appended even where it fails."""
    cfg = subject.cfg
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else None
    # What the numbers depend on: the identity of the predictions, the strategy and how it is scored.
    config_hash = sha256_values([subject.identity, strategy.name, plain(cfg.metrics)])
    row = ResultRow(
        run_id=f"{cfg.run_name}/{strategy.name}-{config_hash[:8]}",
        config_sha256=config_hash,
        overrides=list(overrides) if overrides is not None else None,
        seed=cfg.seed,
        dataset=f"{cfg.data.name}/{cfg.data.test_split}",
        strategy=strategy.name,
        **environment(subject.device, subject.precision),
        **{key: subject.identity[key] for key in ("ckpt_sha256", "weights", "split_sha256", "image_size")},
    )
    try:
        costs = _predict(subject, strategy)
        summary = scorer.score(
            subject.predictions / strategy.name, truth, subject.folder / "scores" / strategy.name, subject.device
        )
        row = replace(row, **summary, **costs)
    except Exception as error:
        status = "nan" if isinstance(error, NonFinitePrediction) else "error"
        status = "oom" if isinstance(error, torch.cuda.OutOfMemoryError) else status
        append_row(cfg.results, replace(row, status=status, error=str(error)))
        raise
    append_row(cfg.results, row)
    return row


def _predict(subject: Subject, strategy: Strategy) -> dict[str, Any]:
    """Predict what is still to do; returns the cost fields of the row."""
    cfg, device = subject.cfg, subject.device
    writer = PredictionWriter(subject.predictions, strategy.name, subject.scene_ids, subject.identity)
    pending = set(writer.pending())
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("PSNR {task.fields[psnr]}"),
        disable=not sys.stderr.isatty(),
        console=Console(stderr=True),
    ) as bar:
        task = bar.add_task(strategy.name, total=len(pending), psnr="–")
        for scene in subject.scenes if pending else ():
            if scene.scene_ids[0] not in pending:
                continue
            scene = scene.to(device)
            watch = Stopwatch(device)
            with watch.measure(), subject.autocast():
                views = strategy.predict(subject.model, scene, cfg.seed)
            writer.write(
                scene.scene_ids[0],
                scene.target_views[0],
                views.images,
                scene.source_views,
                depth=views.depth,
                opacity=views.opacity,
                cost={
                    "seconds": watch.seconds[0],
                    "denoiser_calls": views.denoiser_calls,
                    "field_queries": views.field_queries,
                },
            )
            value = psnr(views.images.clamp(0, 1), scene.targets[0]).mean().item()
            bar.update(task, advance=1, psnr=f"{value:.2f}")
    costs = [json.loads((writer.folder / scene / SCENE).read_text())["cost"] for scene in subject.scene_ids]
    fields: dict[str, Any] = {
        "denoiser_calls": sum(int(cost["denoiser_calls"]) for cost in costs),
        "field_queries": sum(int(cost["field_queries"]) for cost in costs),
    }
    if fields["field_queries"] == 0:
        return fields  # a baseline: no model ran
    fields |= _model_timings(subject) | {"peak_mem_bytes": _peak_memory(device)}
    fields["params"] = subject.model.parameter_count()["total"]
    if fields["denoiser_calls"]:
        # The first scene warms up, unless it is the only one.
        seconds = [cost["seconds"] for cost in costs]
        fields["distill_s"] = summarise(seconds[1:] or seconds)
    return fields


@torch.no_grad()
def _model_timings(subject: Subject) -> dict[str, Any]:
    """Seconds to encode one image and to render one view, the quantities of the paper's speed table."""
    scene, model = next(iter(subject.scenes)).to(subject.device), subject.model
    repeats = {"n": subject.cfg.timing.repeats, "warmup": subject.cfg.timing.warmup, "device": subject.device}
    with subject.autocast():
        inputs = (scene.source, scene.source_cameras, scene.near, scene.far)
        encoding = model.encode(*inputs)
        camera = scene.target_cameras[:, :1]
        return {
            "encode_s": time_calls(lambda: model.encode(*inputs), **repeats),
            "render_s": time_calls(lambda: model.render(encoding, camera), **repeats),
        }


def _peak_memory(device: torch.device) -> int:
    """Bytes: allocated on a GPU; on a CPU the process's resident set, everything it imports included."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _sheet(subject: Subject, strategies: Sequence[Strategy], truth, path: Path) -> Path:
    """Input, truth and every strategy's prediction of some views of some scenes."""
    cfg = subject.cfg
    columns: dict[str, list[torch.Tensor]] = {}
    names = []

    def add(column: str, images: torch.Tensor) -> None:
        columns.setdefault(column, []).append(images)

    for scene in subject.scene_ids[: cfg.sheet.scenes]:
        predictions = {s.name: read_prediction(subject.predictions / s.name, scene) for s in strategies}
        main = predictions[strategies[0].name]
        n = len(main.views)
        shown = [(2 * i + 1) * n // (2 * cfg.sheet.views) for i in range(min(n, cfg.sheet.views))]
        true = truth(scene, [main.source_views[0], *(main.views[i] for i in shown)])
        names += [f"{scene[:10]} {main.views[i]}" for i in shown]
        add("input", true.images[:1].expand(len(shown), -1, -1, -1))
        add("truth", true.images[1:])
        for name, prediction in predictions.items():
            add(name, prediction.pixels[shown].float() / 255)
        if main.depth is not None:
            add("depth", colour_depth(main.depth[shown], true.near, true.far, main.opacity[shown]))
    contact_sheet(path, {name: torch.cat(images) for name, images in columns.items()}, names)
    return path


def _video(subject: Subject, strategy: Strategy, path: Path) -> Path | None:
    """A circle around the first scenes, side by side."""
    options = subject.cfg.orbit
    strips = []
    for index, scene in enumerate(subject.scenes):
        if index == options.scenes:
            break
        cameras = orbit(scene.source_cameras, scene.target_cameras[0], options.frames)[None]
        frames = scene.source_pixels[:, None].expand(-1, options.frames, -1, -1, -1)
        view: ViewBatch = replace(
            scene, target_cameras=cameras, target_pixels=frames, target_depth=None, target_mask=None
        )
        with subject.autocast():
            strips.append(strategy.predict(subject.model, view.to(subject.device), subject.cfg.seed).images.cpu())
    return orbit_video(path, torch.cat(strips, -1), options.fps) if strips else None
