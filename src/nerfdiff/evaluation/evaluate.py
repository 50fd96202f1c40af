"""One evaluation: predictions first, scores after, a row of results, pictures."""

import logging
import sys
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console

from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.scene import MissingSplit
from nerfdiff.distill.baselines import CopyInput, MeanImage, mean_training_image
from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.dashboard import show_in_dashboard
from nerfdiff.evaluation.measure import measure, record_failure
from nerfdiff.evaluation.pictures import sheet, video
from nerfdiff.evaluation.predict import done, predict, require_all
from nerfdiff.evaluation.run import choose_device, dataset_run
from nerfdiff.results.row import ResultRow
from nerfdiff.results.table import rich_table, write_markdown
from nerfdiff.stopping import Stopped
from nerfdiff.stress.stress import with_stress

log = logging.getLogger(__name__)


def evaluate(cfg: DictConfig) -> list[ResultRow]:
    """Evaluate `cfg.strategy`, and the baselines beside it, on one split of a dataset.

    Leaves in `<cfg.paths.output_dir>/<strategy>-<identity>/`: `predictions/<strategy>/`, `scores/<strategy>/`, a
    contact sheet, an orbit video and a table; appends a row per strategy to `cfg.results` and shows it in TensorBoard
    (`cfg.dashboard`). Scenes already predicted by the same model with the same settings on the same files are not
    predicted again.

    Returns:
        the strategy's row, then the baselines'; of these the mean image only where there are training images.

    Raises:
        UserError: bad data, config or checkpoint. A strategy that fails is appended as a row with its status first.
    """
    cfg = with_stress(cfg, "distill")
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    run = dataset_run(cfg, choose_device(cfg.device))
    reader = run.data.reader("test")
    strategies: list[Strategy] = [
        run.stressed(instantiate(cfg.strategy)),
        *(_baselines(cfg, run.data) if cfg.baselines else ()),
    ]
    scorer = instantiate(cfg.metrics)
    rows = []
    for strategy in strategies:
        try:
            predict(run, strategy)
            require_all(run, strategy)
            rows.append(measure(run, strategy, scorer, reader))
        except Stopped as stopped:
            raise Stopped(stopped.signum, done(run, strategy)) from None
        except Exception as error:
            record_failure(cfg, error, run, strategy)
            raise
    pictures = sheet(run, strategies, run.folder / "sheet.png") if cfg.sheet.scenes > 0 else None
    log.info("contact sheet: %s", pictures or "none")
    show_in_dashboard(cfg, rows, pictures)
    if cfg.orbit.scenes > 0:
        log.info("video: %s", video(run, strategies[0], run.folder / "orbit.mp4"))
    show(rows, run.folder / "table.md")
    log.info("rows: %s   scores per image and scene: %s", cfg.results, run.folder / "scores")
    return rows


def _baselines(cfg: DictConfig, data: SceneDataModule) -> list[Strategy]:
    """Build the baselines; without the mean training image where only the test split was downloaded."""
    try:
        reader = data.reader("train")
    except MissingSplit as error:
        log.warning("the baseline mean_image is left out: it needs training images, and there are none (%s)", error)
        return [CopyInput()]
    return [CopyInput(), MeanImage(mean_training_image(reader, cfg.mean_image_scenes, cfg.seed))]


def show(rows: list[ResultRow], path: Path) -> None:
    """Print the table, and write it down."""
    write_markdown(path, rows)
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(rich_table(rows, console.width))
