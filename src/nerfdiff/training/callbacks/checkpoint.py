"""Checkpoints a run can be resumed from, written so that a failure never costs the one before."""

import logging
import os
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint

from nerfdiff.checkpoint import DIVERGED, LAST, PREVIOUS
from nerfdiff.stopping import GIVE_WAY, Stopped, on_signals
from nerfdiff.training.callbacks.nonfinite import NonFiniteGuard
from nerfdiff.utils.errors import CheckpointError, DataError, TrainingDiverged, size_text
from nerfdiff.utils.files import atomic
from nerfdiff.utils.rank import is_first

log = logging.getLogger(__name__)

UPSET = 3
"""Steps in a row in which a loss may jump by chance."""


class SoundCheckpoint(ModelCheckpoint):
    """A checkpoint that is not saved while steps go wrong, see `NonFiniteGuard`."""

    def _should_skip_saving_checkpoint(self, trainer: Trainer) -> bool:
        return super()._should_skip_saving_checkpoint(trainer) or _most(trainer, _guard(trainer).upset) > 0


class LastCheckpoint(SoundCheckpoint):
    """`last.ckpt`: every n optimizer steps, and when a person or a scheduler stops the run; `previous.ckpt` before it.

    It saves only between optimizer steps: halfway through an accumulation window the gradients gathered so far would
    be lost and the resumed run would differ from an uninterrupted one. So the first Ctrl-C or SIGTERM, to any of the
    processes, lets the step end; the same once more ends the run at once. (A scheduler may
    send SIGTERM and another.)

    While steps go wrong nothing is saved. Where the run then diverges, a checkpoint that no good step followed is set
    aside as `diverged.ckpt`, and the one before takes its place. Where not even the first
    step was good, that is done once, and if there is one before: trying again must not cost all checkpoints.

    Args:
        dirpath: folder of the checkpoints.
        every_n_steps: optimizer steps between checkpoints.
    """

    def __init__(self, dirpath: str, every_n_steps: int):
        super().__init__(
            dirpath=dirpath,
            filename=Path(LAST).stem,
            every_n_train_steps=every_n_steps,
            save_top_k=1,
            enable_version_counter=False,
        )
        self._due = False
        self._proven = False  # whether a good step followed the last checkpoint
        self._well = False  # whether any step of this process was good
        self._signum = 0
        self._asked: set[int] = set()
        self._agreed = False  # whether all processes end after the same step
        self._handlers = ExitStack()

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        folder = Path(self.dirpath)
        folder.mkdir(parents=True, exist_ok=True)
        # Weights, their average and Adam's two moments; in the last two files and one that is being written
        files = 3 - sum((folder / name).is_file() for name in (LAST, PREVIOUS))
        needed = files * 4 * sum(p.numel() * p.element_size() for p in pl_module.parameters())
        free = shutil.disk_usage(folder).free
        if free < needed:
            raise CheckpointError(
                f"{folder} has {size_text(free)} free; checkpoints of this model need {size_text(needed)}. "
                "Free some space or choose another paths.runs_dir"
            )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._handlers.enter_context(on_signals(self._ask))

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any, **kwargs: Any) -> None:
        if not _between_steps(trainer):
            return
        step = trainer.global_step
        good = _guard(trainer).upset == 0
        self._well |= good
        self._proven |= good and step > self._last_global_step_saved
        self._due |= step % self._every_n_train_steps == 0
        asked = _most(trainer, self._signum)
        # The last step too; once `fit` ends, the EMA callback has put its average where the raw weights were.
        if asked or step == trainer.max_steps or trainer.should_stop:
            self._save_if_sound(trainer)
        elif self._due and not self._should_skip_saving_checkpoint(trainer):
            self._save_checkpoint(trainer, self.format_checkpoint_name({}))
        if asked:
            raise Stopped(asked)

    def on_validation_batch_end(self, trainer: Trainer, *args: Any, **kwargs: Any) -> None:
        if not trainer.sanity_checking and (asked := _most(trainer, self._signum)):
            self._agreed = True
            raise Stopped(asked)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._handlers.close()
        if self._agreed:  # in a validation, which a resumed run begins anew
            progress = trainer.fit_loop.epoch_loop.val_loop.batch_progress
            progress.reset()
            progress.increment_ready()
            progress.increment_started()
            self._save_if_sound(trainer)
        elif isinstance(exception, TrainingDiverged) and trainer.is_global_zero and not self._proven:
            self._set_aside()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._handlers.close()
        super().on_train_end(trainer, pl_module)

    def _ask(self, signum: int) -> None:
        if signum in self._asked:
            raise Stopped(signum)
        self._asked.add(signum)
        if self._signum not in GIVE_WAY:  # it says more than SIGTERM beside it
            self._signum = signum
        if len(self._asked) > 1:
            return
        if is_first():
            log.warning("stopping: this step ends and is saved first; asked once more, the run ends at once")

    def _save_if_sound(self, trainer: Trainer) -> None:
        """Save what a person or a scheduler wants to keep, also where the loss of the last step is a chance jump."""
        guard = _guard(trainer)
        wrong = _most(trainer, guard.upset if guard.in_a_row or guard.upset >= UPSET else 0)
        if wrong:
            log.warning("the last %d steps went wrong and are not saved", wrong)
        elif self._last_global_step_saved != trainer.global_step > 0:
            self._save_checkpoint(trainer, self.format_checkpoint_name({}))

    def _save_checkpoint(self, trainer: Trainer, filepath: str) -> None:
        super()._save_checkpoint(trainer, filepath)
        self._due = self._proven = False

    def _set_aside(self) -> None:
        last, previous, diverged = (Path(self.dirpath) / name for name in (LAST, PREVIOUS, DIVERGED))
        if not self._well and (diverged.exists() or not previous.exists()):
            return
        if last.exists():
            os.replace(last, diverged)
        if previous.exists():
            os.replace(previous, last)


class ClearCheckpointIO(TorchCheckpointIO):
    """Checkpoint files that are whole or absent, with a clear word when one cannot be written.

    Lightning's own writes to the system's temporary folder first, which may be another disk.

    Raises:
        CheckpointError: the file cannot be written; the checkpoint it was to replace is untouched.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path, storage_options: Any = None) -> None:
        path = Path(path)
        try:
            with atomic(path, former=path.with_name(PREVIOUS) if path.name == LAST else None) as temporary:
                torch.save(checkpoint, temporary)
        except (OSError, RuntimeError, DataError) as error:  # torch turns a failed write into a RuntimeError
            free = shutil.disk_usage(path.parent).free
            raise CheckpointError(
                f"cannot write {path}: {str(error).splitlines()[0]} ({size_text(free)} free). The checkpoint "
                "before it is kept: free some space and run the same command again to go on from there"
            ) from error


def _between_steps(trainer: Trainer) -> bool:
    return trainer.fit_loop.epoch_loop.batch_progress.current.ready % trainer.accumulate_grad_batches == 0


def _guard(trainer: Trainer) -> NonFiniteGuard:
    """Return the callback that watches for failed steps; without it all count as good."""
    guards = [callback for callback in trainer.callbacks if isinstance(callback, NonFiniteGuard)]
    return guards[0] if guards else NonFiniteGuard(patience=1, spike=1.0, memory=1)


def _most(trainer: Trainer, number: int) -> int:
    """Return the largest of all processes' numbers, so that they do the same."""
    if trainer.world_size == 1:
        return number
    mine = torch.tensor(number, device=trainer.strategy.root_device)
    return int(trainer.strategy.reduce(mine, reduce_op="max"))
