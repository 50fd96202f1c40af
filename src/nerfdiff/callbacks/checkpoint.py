"""Checkpoints a run can be resumed from, written so that a failure never costs the one before."""

import shutil
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities.exceptions import SIGTERMException

from nerfdiff.errors import CheckpointError, DataError
from nerfdiff.results.files import atomic


class LastCheckpoint(ModelCheckpoint):
    """`last.ckpt`: every n optimizer steps, and when a person or a scheduler stops the run.

    On SIGTERM and Ctrl-C it saves only between optimizer steps: halfway through an accumulation window the
    gradients gathered so far would be lost and the resumed run would differ from an uninterrupted one.

    Args:
        dirpath: folder of the checkpoints.
        every_n_steps: optimizer steps between checkpoints.
    """

    def __init__(self, dirpath: str, every_n_steps: int):
        super().__init__(
            dirpath=dirpath,
            filename="last",
            every_n_train_steps=every_n_steps,
            save_top_k=1,
            enable_version_counter=False,
        )

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # Weights, their average and Adam's two moments; two files exist while one replaces the other.
        needed = 2 * 4 * sum(p.numel() * p.element_size() for p in pl_module.parameters())
        folder = Path(self.dirpath)
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
        if free < needed:
            raise CheckpointError(
                f"{folder} has {free / 2**20:.0f} MiB free; checkpoints of this model need {needed / 2**20:.0f} MiB. "
                "Free some space or choose another paths.runs_dir"
            )

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any, **kwargs: Any) -> None:
        super().on_train_batch_end(trainer, pl_module, *args, **kwargs)
        # The last step too; once `fit` ends, the EMA callback has put its average where the raw weights were.
        if trainer.global_step == trainer.max_steps and self._last_global_step_saved != trainer.global_step:
            self._save_checkpoint(trainer, self.format_checkpoint_name({}))

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        # A SIGTERM to the whole process group kills the loader's workers first, which raises something else.
        stopped = isinstance(exception, SIGTERMException | KeyboardInterrupt) or trainer.received_sigterm
        batches = trainer.fit_loop.epoch_loop.batch_progress.current
        between_steps = batches.ready == batches.processed and batches.ready % trainer.accumulate_grad_batches == 0
        unsaved = self._last_global_step_saved != trainer.global_step > 0
        if stopped and between_steps and unsaved and not trainer.sanity_checking:
            self._save_checkpoint(trainer, self.format_checkpoint_name({}))


class ClearCheckpointIO(TorchCheckpointIO):
    """Checkpoint files that are whole or absent, with a clear word when one cannot be written.

    Lightning's own writes to the system's temporary folder first, which may be another disk.

    Raises:
        CheckpointError: the file cannot be written; the checkpoint it was to replace is untouched.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path, storage_options: Any = None) -> None:
        path = Path(path)
        try:
            with atomic(path) as temporary:
                torch.save(checkpoint, temporary)
        except (OSError, RuntimeError, DataError) as error:  # torch turns a failed write into a RuntimeError
            free = shutil.disk_usage(path.parent).free
            raise CheckpointError(
                f"cannot write {path}: {str(error).splitlines()[0]} ({free / 2**20:.0f} MiB free). The checkpoint "
                "before it is kept: free some space and run the same command again to go on from there"
            ) from error
