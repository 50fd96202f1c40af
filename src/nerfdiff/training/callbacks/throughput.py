"""Images per second of a training."""

import time

from lightning import Callback, LightningModule, Trainer


class Throughput(Callback):
    """Logs target images per second over the steps since the last logging, validation left out."""

    def __init__(self) -> None:
        self._images = 0
        self._seconds = 0.0
        self._start: float | None = None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch, batch_idx: int) -> None:
        if self._start is None:
            self._start = time.perf_counter()

    def on_train_batch_end(self, trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        self._images += batch.targets.shape[0] * batch.targets.shape[1] * trainer.world_size
        if (batch_idx + 1) % trainer.log_every_n_steps == 0:
            self._pause()
            pl_module.log("train/images_per_s", self._images / self._seconds)
            self._images, self._seconds = 0, 0.0

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._pause()

    def _pause(self) -> None:
        if self._start is not None:
            self._seconds += time.perf_counter() - self._start
            self._start = None
