"""Progress of a training: a bar on a terminal, elsewhere a line now and then."""

import logging
import sys
import time

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, Timer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

log = logging.getLogger(__name__)


class TrainingProgress(ProgressBar):
    """Counts optimizer steps, and says the loss, the rendering's PSNR on the training views and the time left.

    Args:
        every_steps, every_seconds: off a terminal, a line follows the last after so many steps or seconds, whichever
            come first. The first step has one in any case.
    """

    def __init__(self, every_steps: int, every_seconds: float):
        super().__init__()
        self.every_steps, self.every_seconds = every_steps, every_seconds
        self._bar: Progress | None = None

    def disable(self) -> None:
        """Do nothing: Lightning calls this in all processes but the first, which print nothing in any case."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._first = self._said = trainer.global_step
        self._began = time.monotonic()
        self._said_at = -float("inf")
        if trainer.is_global_zero and sys.stderr.isatty():
            columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
            words = TextColumn("{task.fields[words]}")
            self._bar = Progress(TextColumn("step"), *columns, words, console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("", total=trainer.max_steps, completed=trainer.global_step, words="")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        step, now = trainer.global_step, time.monotonic()
        if not trainer.is_global_zero or step == self._said:
            return
        if self._bar is not None:
            if now - self._said_at > 0.5:  # to say the loss, the host waits for the device
                self._bar.update(self._task, completed=step, words=_words(trainer))
                self._said, self._said_at = step, now
        elif step - self._said >= self.every_steps or now - self._said_at >= self.every_seconds:
            rate = (step - self._first) / (now - self._began)
            seconds, timer = (trainer.max_steps - step) / rate, timer_of(trainer)
            left = duration(seconds if timer is None else max(0.0, min(seconds, timer.time_remaining())))
            log.info("step %d of %d, %s, %.3g steps/s, %s left", step, trainer.max_steps, _words(trainer), rate, left)
            self._said, self._said_at = step, now

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._close(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._close(trainer)

    def _close(self, trainer: Trainer) -> None:
        if self._bar is not None:
            self._bar.update(self._task, completed=trainer.global_step)
            self._bar.stop()
            self._bar = None


def _words(trainer: Trainer) -> str:
    known = {"loss": "train/loss", "PSNR": "psnr"}
    values = {name: trainer.callback_metrics.get(key) for name, key in known.items()}
    return ", ".join(f"{name} {float(value):.3g}" for name, value in values.items() if value is not None)


def duration(seconds: float) -> str:
    """Return a time in words."""
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min" if minutes else f"{seconds:.0f} s"


def timer_of(trainer: Trainer) -> Timer | None:
    """Return the timer of `trainer.max_time`; None without such a limit."""
    return next((callback for callback in trainer.callbacks if isinstance(callback, Timer)), None)


def share_of_time(timer: Timer) -> float:
    """Return the share of the limit that has passed, over all sessions of the run."""
    passed = timer.time_elapsed()
    return passed / (passed + timer.time_remaining())
