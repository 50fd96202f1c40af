"""A live word on how a distillation goes."""

import time
from collections.abc import Callable

from lightning import Callback, LightningModule, Trainer


class DistillationBar(Callback):
    """Says t and how well the fields' renderings agree with their targets.

    Args:
        tell: receives the words.
        every: seconds between words: to say them, the host waits for the device.
    """

    def __init__(self, tell: Callable[[str], None], every: float = 0.5):
        self.tell, self.every = tell, every
        self._told = -float("inf")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        if time.monotonic() - self._told < self.every:
            return
        t, agreement = pl_module.progress()
        where = f"step {batch_idx + 1}" if t is None else f"t {t:.2f}"
        reached = "–" if agreement is None else f"{agreement:.1f} dB"
        self.tell(f"{where}, renders against targets {reached}")
        self._told = time.monotonic()
