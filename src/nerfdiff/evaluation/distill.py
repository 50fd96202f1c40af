"""One strategy over the scenes of a dataset, or over one picture, on one or several processes."""

import logging
import re
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning import Fabric
from lightning.fabric.strategies import DDPStrategy
from omegaconf import DictConfig

from nerfdiff.distill.strategy import Strategy
from nerfdiff.distill.trace import TRACE
from nerfdiff.evaluation.dashboard import show_in_dashboard, show_picture
from nerfdiff.evaluation.evaluate import show
from nerfdiff.evaluation.measure import measure, record_failure
from nerfdiff.evaluation.pictures import sheet
from nerfdiff.evaluation.predict import costs, done, predict, require_all
from nerfdiff.evaluation.run import EvaluationRun, choose_device, dataset_run, picture_run
from nerfdiff.processes import end_launched, lost_process, watch
from nerfdiff.results.row import ResultRow
from nerfdiff.stopping import Stopped
from nerfdiff.stress.stress import with_stress
from nerfdiff.utils.config import plain
from nerfdiff.utils.errors import ConfigError, ProcessLost

log = logging.getLogger(__name__)


def distill(cfg: DictConfig) -> ResultRow | None:
    """Run `cfg.strategy` over the test scenes of `cfg.data`, or over the picture `cfg.image`.

    Leaves in `<cfg.paths.output_dir>/<strategy>-<identity>/predictions/<strategy>/<scene>/` the rendered views, the
    field, its trace and an orbit; beside them scores and a contact sheet, and a row in `cfg.results`, which TensorBoard
    shows (`cfg.dashboard`). Scenes that are done are skipped. Every process makes its share of the scenes.

    Returns:
        the row; None for a picture, whose other views nobody knows, and in all processes but the first.

    Raises:
        UserError: bad data, picture, config or checkpoint. A run over a dataset is appended as a failed row first;
            within a sweep the row is all, and the other jobs go on.
    """
    run, strategy = None, None
    try:
        cfg = with_stress(cfg, "distill")
        fabric = _launch(cfg)
        run = picture_run(cfg, fabric.device) if cfg.image else dataset_run(cfg, fabric.device)
        strategy, scorer = run.stressed(build_strategy(cfg)), None if cfg.image else instantiate(cfg.metrics)
        _predict_together(fabric, run, strategy)
        if fabric.global_rank > 0:
            return None
        require_all(run, strategy)
        row = measure(run, strategy, scorer, run.data.reader("test")) if run.data else None
    except Stopped as stopped:
        end_launched(stopped.signum)
        raise Stopped(stopped.signum, done(run, strategy) if run and strategy else "") from None
    except Exception as error:
        if cfg.image or _rank() > 0:
            raise
        row = record_failure(cfg, error, run, strategy)
        if _in_a_sweep():
            log.exception("this job of the sweep failed")
            return row
        raise
    pictures = sheet(run, [strategy], run.folder / "sheet.png") if cfg.sheet.scenes > 0 else None
    log.info("contact sheet: %s", pictures or "none")
    if row is not None:
        show_in_dashboard(cfg, [row], pictures)
        show([row], run.folder / "table.md")
    if cfg.image:
        (scene,), (cost,) = run.scene_ids, costs(run, strategy)
        log.info("verdict: %s", cost["verdict"])
        facts = {"picture": cfg.image, "verdict": cost["verdict"], "status": cost["status"], "folder": str(run.folder)}
        trace = run.predictions / strategy.name / scene / TRACE
        show_picture(cfg, Path(cfg.results).parent, scene, facts, pictures, trace if trace.is_file() else None)
    log.info("fields, traces and orbits: %s", run.predictions / strategy.name)
    return row


def build_strategy(cfg: DictConfig) -> Strategy:
    """Build `cfg.strategy`; for a picture with `cfg.picture_views` as Π, instead of a dataset's."""
    settings = plain(cfg.strategy)
    if cfg.image and "prior" in settings:
        settings["prior"] = plain(cfg.picture_views)
        _warn_of_unused(HydraConfig.get().overrides.task if HydraConfig.initialized() else ())
    return instantiate(settings)


def _warn_of_unused(overrides: Sequence[str]) -> None:
    unused = [word for word in overrides if re.match(r"[+~]*(prior|data)\b", word)]
    if unused:
        log.warning(
            "%s cannot act on a picture: its views are picture_views, and it needs no dataset", ", ".join(unused)
        )


def _rank() -> int:
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def _in_a_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _launch(cfg: DictConfig) -> Fabric:
    """Launch the processes that share the scenes: one per GPU, or several on the CPU.

    Raises:
        ConfigError: there are not as many devices, or every job of a sweep would launch its own.
    """
    device = choose_device(cfg.device)
    if cfg.processes < 1 or (device.type == "cuda" and cfg.processes > torch.cuda.device_count()):
        raise ConfigError(f"processes={cfg.processes} must be at least 1, and on GPUs at most one for each")
    many = cfg.processes > 1
    if many and _in_a_sweep():
        raise ConfigError("processes is for a single run: the jobs of a sweep take one each, side by side if at all")
    if many and device.index is not None:
        raise ConfigError(f"device={cfg.device} is one device: say device={device.type} with processes={cfg.processes}")
    devices = [device.index or 0] if device.type == "cuda" and not many else cfg.processes
    # Processes meet when all are done, however long the longest takes.
    # They send each other words only, and gloo notices when one dies.
    strategy = DDPStrategy(timeout=timedelta(days=30), process_group_backend="gloo") if many else "auto"
    watch()
    fabric = Fabric(accelerator=device.type, devices=devices, strategy=strategy)
    fabric.launch()
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    return fabric


def _predict_together(fabric: Fabric, run: EvaluationRun, strategy: Strategy) -> None:
    """Predict this process's share. Where one fails the others finish theirs, and all then fail with its message."""
    failure: Exception | None = None
    try:
        predict(run, strategy, fabric.global_rank, fabric.world_size)
    except Exception as error:
        if fabric.world_size == 1:
            raise
        log.exception("process %d failed", fabric.global_rank)
        failure = error
    if fabric.world_size == 1:
        return
    words: list[str | None] = [None] * fabric.world_size
    try:
        torch.distributed.all_gather_object(words, failure and f"{type(failure).__name__}: {failure}")
    except RuntimeError as error:
        if not (sentence := lost_process(error)):
            raise
        raise ProcessLost(f"{sentence} {done(run, strategy)} The same command goes on") from (failure or error)
    if failure is not None:
        raise failure
    for rank, said in enumerate(words):
        if said is not None:
            raise RuntimeError(f"process {rank} of {fabric.world_size} failed ({said})")
