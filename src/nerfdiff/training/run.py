"""One training run, from a composed config to a model on disk."""

import logging
import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from lightning.fabric.plugins.environments import SLURMEnvironment, TorchElasticEnvironment
from omegaconf import DictConfig

from nerfdiff.checkpoint import (
    DAMAGED,
    check_finite,
    check_resumable,
    check_same_data,
    describe,
    differences,
    last_checkpoint,
    load_model,
    read_checkpoint,
    steps_of,
)
from nerfdiff.compilation import compile_unets
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.diffusion.layout import channels_last
from nerfdiff.diffusion.unet import AUTO
from nerfdiff.exported_model import export_model
from nerfdiff.inputs import LAST, find_weights
from nerfdiff.model import settings_of
from nerfdiff.processes import lost_process, watch
from nerfdiff.stability.judge import OK
from nerfdiff.stopping import Stopped
from nerfdiff.stress.stress import stress_of, stressed_readers, with_stress
from nerfdiff.training.callbacks.checkpoint import ClearCheckpointIO
from nerfdiff.training.callbacks.record import Record
from nerfdiff.training.memory import WEIGHTS_ADAM_EMA, is_tight, within_memory
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.training.rows import append_training_row, verdict
from nerfdiff.utils.config import auto_precision, plain
from nerfdiff.utils.errors import CheckpointError, ConfigError, ProcessLost, TrainingDiverged
from nerfdiff.utils.files import held, remove_leftovers
from nerfdiff.utils.hashes import sha256_file, sha256_values
from nerfdiff.utils.rank import set_rank

log = logging.getLogger(__name__)

PAPERS = 1e8  # parameters from which a model is of the paper's sizes


def train(cfg: DictConfig) -> dict[str, float]:
    """Train, or go on training, the run of `cfg.paths.output_dir`.

    Leaves there `checkpoints/last.ckpt` and `best.ckpt`, `model/` (averaged weights as safetensors with their
    settings), `previews/` and TensorBoard logs.

    Returns:
        the last logged metrics.

    Raises:
        UserError: bad data, config, checkpoint, or a run that diverged; the message says what to do. Where there is a
            `cfg.results`, a row tells it too.
    """
    watch()
    # Seeds the initial weights, and dropout where a model has it. All other randomness is a function of cfg.seed and
    # the draw (nerfdiff.utils.randomness), which a resumed run takes up where it was.
    seed_everything(cfg.seed, verbose=False)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    cfg, trainer = with_stress(cfg, "train"), None
    try:
        trainer = build_trainer(cfg)
        set_rank(trainer.global_rank)
        with held(Path(cfg.paths.output_dir)) if trainer.is_global_zero else nullcontext():
            found = _train(cfg, trainer)
    except Exception as error:
        if cfg.results is not None and not isinstance(error, Stopped):
            append_training_row(cfg, trainer, error)
        raise
    if cfg.results is not None and trainer.is_global_zero:
        append_training_row(cfg, trainer, None)
    return found


def _train(cfg: DictConfig, trainer: Trainer) -> dict[str, float]:
    output_dir = Path(cfg.paths.output_dir)
    if trainer.is_global_zero:
        for folder in (output_dir, *(output_dir / name for name in ("checkpoints", "model", "previews", "snapshots"))):
            remove_leftovers(folder)
    model_config = settings_of(cfg)
    datamodule = instantiate(cfg.data)
    if (stress := stress_of(cfg)) is not None:
        datamodule.make_reader = stressed_readers(datamodule.make_reader, stress, cfg.data.train_split)
    last = _checkpoint_to_resume(output_dir, cfg, model_config, datamodule)
    model_config = _within_memory(model_config, trainer, datamodule)
    module = NerfDiffModule(
        model=model_config,
        losses=plain(cfg.losses),
        optimizer=plain(cfg.optimizer),
        validation_times=plain(cfg.validation_times),
        channels_last=channels_last(cfg.channels_last, trainer.strategy.root_device, cfg.compile != "none"),
        seed=cfg.seed,
        kept_renderings=_kept_renderings(cfg, datamodule),
        renderer={"backend": cfg.backend, "kernel_precision": cfg.kernel_precision},
    )
    if last is None:
        _begin(module, cfg, model_config)
    compile_unets(module.model, cfg.compile, cfg.paths.compiled_dir)
    _announce(module, last, trainer, datamodule.batch_size)
    damaged = output_dir / "checkpoints" / LAST
    if trainer.is_global_zero and last is not None and damaged.exists() and steps_of(damaged) is None:
        os.replace(damaged, damaged.with_name(DAMAGED))  # else it would take the place of the one that is good

    try:
        trainer.fit(module, datamodule, ckpt_path=last, weights_only=True)
    except Stopped as stopped:
        raise Stopped(stopped.signum, describe(last_checkpoint(output_dir))) from None
    except TrainingDiverged as error:
        raise TrainingDiverged(f"{error}. {_sound(output_dir)}") from error
    except RuntimeError as error:
        if trainer.world_size == 1 or not (sentence := lost_process(error)):
            raise
        raise ProcessLost(f"{sentence} {describe(last_checkpoint(output_dir))} The same command goes on") from error

    if trainer.is_global_zero:
        # From the file, not the module: resuming a run that is complete leaves raw weights in the module.
        weights = "ema" if cfg.callbacks.get("ema") else "raw"
        loaded = load_model(last_checkpoint(output_dir), weights, cfg.paths.assets_dir)
        path = export_model(loaded, output_dir / "model", torch.float32)
        log.info("weights: %s", path)
        if (said := verdict(trainer.callback_metrics)) not in (None, OK):
            log.warning("this training is %s", said)
        log.info("previews: %s   curves: tensorboard --logdir %s", output_dir / "previews", output_dir)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def _begin(module: NerfDiffModule, cfg: DictConfig, model_config: dict) -> None:
    """Give a new run the weights of `cfg.init`."""
    if cfg.init is None:
        if module.frozen_field:
            raise ConfigError("losses.lambda_ic=0 trains the CDM on a field that stays as it is: set init=<checkpoint>")
        return
    begun = load_model(cfg.init, "ema", cfg.paths.assets_dir)
    try:
        module.model.load_state_dict(begun.model.state_dict())
    except RuntimeError as error:  # of other names or sizes
        changed = "; ".join(differences(begun.config, model_config, "model."))
        raise CheckpointError(f"init={cfg.init} does not fit this run's model ({changed}): use its settings") from error
    module.trained_before, module.begun_from = list(begun.trained_on), sha256_file(begun.path)


def _kept_renderings(cfg: DictConfig, data: SceneDataModule) -> str | None:
    """Return the folder for a frozen field's renderings, named by the data and the renderer."""
    if not cfg.kept_renderings:
        return None
    if data.source_target_noise:
        raise ConfigError(
            f"kept_renderings are of the views' own cameras, and data.source_target_noise={data.source_target_noise} "
            "moves some of these at every step: set it to 0, or kept_renderings to null"
        )
    reader = data.reader("train")
    what = [plain(cfg.model.render), reader.identity, reader.fingerprint()]
    return str(Path(cfg.kept_renderings) / sha256_values(what)[:12])


def _within_memory(model_config: dict, trainer: Trainer, data: SceneDataModule) -> dict:
    device = trainer.strategy.root_device
    if model_config["unet"]["checkpointing"] != AUTO and not is_tight(model_config, device):
        return model_config
    first = data.reader("train").load(0, [0]).cameras
    batch_size = max(1, data.batch_size // (trainer.world_size * trainer.accumulate_grad_batches))
    size = first.height, first.width
    return within_memory(model_config, device, batch_size, data.target_views, *size, trainer.precision)


def build_trainer(cfg: DictConfig) -> Trainer:
    """Build the Lightning Trainer of a composed training config."""
    options: dict[str, Any] = {}
    if cfg.trainer.precision == "auto":
        options["precision"] = auto_precision(cfg.trainer.accelerator)
    if cfg.trainer.benchmark == "auto":
        options["benchmark"] = not cfg.trainer.deterministic
    logger = cfg.get("logger")
    # Without a logger there is nowhere to write the learning rate to.
    wanted = {name: node for name, node in cfg.callbacks.items() if logger or name != "learning_rate"}
    try:
        return instantiate(
            cfg.trainer,
            logger=instantiate(logger) if logger else False,
            callbacks=[
                Record(cfg, Path(cfg.paths.output_dir) / "config.yaml"),  # first: others read it
                *(instantiate(callback) for callback in wanted.values() if callback is not None),
            ],
            enable_progress_bar=cfg.callbacks.get("progress") is not None,
            plugins=[ClearCheckpointIO(), *_scheduler()],
            # where Lightning looks for checkpoints that a scheduler made it write: not among those of other runs
            default_root_dir=cfg.paths.output_dir,
            # Lightning counts batches where we count optimizer steps.
            val_check_interval=cfg.validation_every * cfg.trainer.accumulate_grad_batches,
            check_val_every_n_epoch=None,
            **options,
        )
    except InstantiationException as error:
        raise ConfigError(f"the trainer cannot be set up: {error.__cause__ or error}") from error


def _scheduler() -> list[SLURMEnvironment]:
    """Under Slurm's srun, its environment without Lightning's queueing again, which saves within steps."""
    if TorchElasticEnvironment.detect() or not SLURMEnvironment.detect():
        return []
    return [SLURMEnvironment(auto_requeue=False)]


def _checkpoint_to_resume(output_dir: Path, cfg: DictConfig, model_config: dict, data: SceneDataModule) -> Path | None:
    last = last_checkpoint(output_dir)
    if not last.is_file():
        return None
    if not cfg.resume:
        raise CheckpointError(
            f"{output_dir} holds the checkpoint of an earlier run and resume=false: choose another run_name, or "
            "delete that folder"
        )
    check_resumable(last, model_config, cfg.trainer.accumulate_grad_batches)
    try:
        check_same_data(last, data.state_dict())
    except CheckpointError as error:
        if not cfg.other_data:
            raise
        log.warning("%s", error)
    begun_from = read_checkpoint(last).get("begun_from")
    if cfg.init is not None and begun_from is not None:
        init = find_weights(cfg.init, cfg.paths.assets_dir)
        if sha256_file(init) != begun_from:
            raise CheckpointError(
                f"the run of {last} began with other weights than init={cfg.init} has now ({init}): choose another "
                "run_name to start afresh with these, or leave init out to go on"
            )
    return last


def _sound(output_dir: Path) -> str:
    """Say which checkpoint of a run that diverged is sound."""
    last = last_checkpoint(output_dir)
    if not last.is_file():
        return "No checkpoint is from before that: start afresh"
    try:
        check_finite(last)
    except CheckpointError as error:
        return f"{error}: start afresh"
    return f"{describe(last)} Its weights are finite: the same command goes on from there"


def _announce(module: NerfDiffModule, last: Path | None, trainer: Trainer, batch_size: int) -> None:
    counts = module.model.parameter_count()
    state = WEIGHTS_ADAM_EMA * counts["total"] / 2**30
    log.info(
        "%s/%s: %.1fM parameters (encoder %.1fM, CDM %.1fM); weights, Adam and EMA take %.2f GiB",
        module.model.name,
        module.model.conditioning,
        *(counts[part] / 1e6 for part in ("total", "encoder", "denoiser")),
        state,
    )
    if trainer.world_size > 1:
        where = f"{trainer.world_size} processes on {trainer.num_nodes} nodes"
    else:
        where = str(trainer.strategy.root_device)
        if counts["total"] > PAPERS:
            log.info(
                "set for one device, with %d images a step on it; the paper's 8 GPUs: experiment=paper_8gpu model=%s",
                *(batch_size, module.model.name),
            )
    log.info("%s on %s", f"resuming from {last}" if last else "starting afresh", where)
