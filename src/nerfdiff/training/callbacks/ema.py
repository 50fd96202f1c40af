"""Exponential moving average of the weights (paper: decay 0.9999)."""

from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor


class EMA(WeightAveraging):
    """Lightning's weight averaging with a warm-up, and with averaged weights wherever the model is used.

    Validation runs on the average, checkpoints hold it as `state_dict` (the raw weights as
    `current_model_state`), and so does the module after `fit`. Lightning's own callback, while it still holds its
    average after `fit`, hands the *raw* weights to `trainer.test(ckpt_path=...)`; this one does so only to go on
    training. An exception during validation swaps the weights back first, so a checkpoint saved then is sound.

    Args:
        decay: share of the average kept at every step.
        warmup: decay at step n is at most (1 + n) / (warmup + n), so that a short run's average is not its start.
    """

    def __init__(self, decay: float, warmup: int):
        def average(averaged: list[Tensor], current: list[Tensor], n: Tensor | int) -> None:
            n = int(n)  # one wait for the GPU for all parameters together
            torch._foreach_lerp_(averaged, current, 1 - min(decay, (1 + n) / (warmup + n)))

        super().__init__(multi_avg_fn=average)
        self._swapped = False

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.state.fn == TrainerFn.FITTING:  # else the weights to validate are those that were loaded
            super().on_validation_epoch_start(trainer, pl_module)
            self._swapped = True

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._swapped:
            super().on_validation_epoch_end(trainer, pl_module)
            self._swapped = False

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self._swapped:
            self._swap_models(pl_module)
            self._swapped = False

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        if trainer.state.fn == TrainerFn.FITTING:
            super().on_load_checkpoint(trainer, pl_module, checkpoint)
