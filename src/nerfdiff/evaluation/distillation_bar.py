"""Progress of a distillation."""

import time
from collections.abc import Callable

from lightning import Callback, LightningModule, Trainer


class DistillationBar(Callback):
    """Report the step, t, and the PSNR of the fields' renderings against their targets.

    Args:
        report: receives the share of the steps that are done, where it is, and what was reached, in words.
        every: seconds between reports, for which the host waits for the device.
    """

    def __init__(self, report: Callable[[float, str, str], None], every: float):
        self.report, self.every = report, every
        self._last = -float("inf")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        if time.monotonic() - self._last < self.every:
            return
        t, agreement = pl_module.progress()
        step, steps = batch_idx + 1, pl_module.steps
        reached = [] if t is None else [f"t {t:.2f}"]
        reached += [] if agreement is None else [f"renders against targets {agreement:.1f} dB"]
        self.report(step / steps, f"step {step} of {steps}", ", ".join(reached))
        self._last = time.monotonic()
