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
        def average(averaged: Tensor, current: Tensor, n: Tensor | int) -> Tensor:
            rate = min(decay, (1 + int(n)) / (warmup + int(n)))
            return torch.lerp(current, averaged, rate)

        super().__init__(avg_fn=average)
        self._swapped = False

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_validation_epoch_start(trainer, pl_module)
        self._swapped = self._average_model is not None

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_validation_epoch_end(trainer, pl_module)
        self._swapped = False

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self._swapped:
            self._swap_models(pl_module)
            self._swapped = False

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        if trainer.state.fn == TrainerFn.FITTING:
            super().on_load_checkpoint(trainer, pl_module, checkpoint)
