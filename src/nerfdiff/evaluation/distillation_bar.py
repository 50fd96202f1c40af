"""A live word on how a distillation goes."""

import time
from collections.abc import Callable

from lightning import Callback, LightningModule, Trainer


class DistillationBar(Callback):
    """Says the step, t, and how well the fields' renderings agree with their targets.

    Args:
        tell: receives the share of the steps that are done, and the words.
        every: seconds between words: to say them, the host waits for the device.
    """

    def __init__(self, tell: Callable[[float, str], None], every: float):
        self.tell, self.every = tell, every
        self._told = -float("inf")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        if time.monotonic() - self._told < self.every:
            return
        t, agreement = pl_module.progress()
        step, steps = batch_idx + 1, pl_module.steps
        where = f"step {step} of {steps}" + ("" if t is None else f", t {t:.2f}")
        reached = "" if agreement is None else f", renders against targets {agreement:.1f} dB"
        self.tell(step / steps, where + reached)
        self._told = time.monotonic()
