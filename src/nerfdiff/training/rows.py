"""A training run as a row of results: how it ended, how calm it was, and its held-out error."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning import Trainer
from omegaconf import DictConfig

from nerfdiff.results.environment import environment
from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.stability.judge import OK
from nerfdiff.stress.stress import row_fields, stress_of
from nerfdiff.training.callbacks.nonfinite import NonFiniteGuard
from nerfdiff.utils.errors import TrainingDiverged, is_out_of_memory


def verdict(held_out: Mapping[str, Any]) -> str | None:
    """Say `suspect` of a training that collapsed: its renderings are no better than pictures of one even colour.

    Returns:
        `ok`, or `suspect: <why>`; None where nothing was held out.
    """
    psnr, even = (held_out.get(name) for name in ("val/psnr", "val/psnr_even"))
    if psnr is None or even is None:
        return None
    if float(psnr) > float(even):
        return OK
    return (
        f"suspect: held-out renderings have {float(psnr):.1f} dB, pictures of one even colour {float(even):.1f} dB: it "
        "has not begun to learn, or has collapsed; train longer, or lower optimizer.lr"
    )


def append_training_row(cfg: DictConfig, trainer: Trainer | None, error: Exception | None) -> ResultRow:
    """Append the row of a run to `cfg.results`. Held-out numbers are the last: of renderings, and the CDM's loss.

    Args:
        cfg: with the settings of its stress.
        trainer: None where the run failed before it had one.
        error: that ended it.
    """
    guard = next((c for c in trainer.callbacks if isinstance(c, NonFiniteGuard)), None) if trainer is not None else None
    stability: dict[str, Any] = guard.stability.summary() if guard is not None else {}
    held_out = {} if trainer is None else trainer.callback_metrics
    psnr, loss = (held_out.get(name) for name in ("val/psnr", "val/loss_dm"))
    status = "ok"
    if error is not None:
        status = "diverged" if isinstance(error, TrainingDiverged) else "oom" if is_out_of_memory(error) else "error"
    hydra = HydraConfig.get() if HydraConfig.initialized() else None
    device = trainer.strategy.root_device if trainer is not None else "cpu"
    row = ResultRow(
        run_id=cfg.run_name,
        status=status,
        error=None if error is None else str(error),
        strategy="training",
        model=cfg.model.name,
        field=cfg.model.field.name,
        dataset=f"{cfg.data.name}/{cfg.data.val_split}",
        seed=cfg.seed,
        overrides=None if hydra is None else list(hydra.overrides.task),
        psnr=None if psnr is None else float(psnr),
        held_out_loss=None if loss is None else float(loss),
        verdict=verdict(held_out),
        **row_fields(stress_of(cfg)),
        **environment(device, cfg.trainer.precision),
        **stability,
    )
    append_row(Path(cfg.results), row)
    return row
