"""Processes of one run that notice when another is gone, on whatever host and over whatever network."""

import os
import sys
import threading
from datetime import timedelta
from pathlib import Path

import torch
from lightning import Callback, LightningModule, Trainer
from torch import distributed

from nerfdiff.checkpoint import describe, last_checkpoint
from nerfdiff.processes import GRACE, gone


class Heartbeat(Callback):
    """Ends this process, with a sentence, where another one of its run ended or cannot be reached.

    A collective of NCCL waits half an hour for a process that is gone, and one of gloo for a link that is cut. So all
    processes meet every few seconds, in a group of their own and beside the training.

    Args:
        run: the run's folder, for the sentence.
        every: seconds between two beats.
        patience: seconds that a beat may be late. A process that is dead is noticed at once.
    """

    def __init__(self, run: str, every: float, patience: float):
        self.run, self.every, self.patience = Path(run), every, patience
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.world_size > 1:
            self.start()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join(self.patience)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.stop()

    def start(self) -> None:
        """Begin; all processes of the run are to do so."""
        group = distributed.new_group(backend="gloo", timeout=timedelta(seconds=self.patience))
        self._ended.clear()
        self._thread = threading.Thread(target=self._beat, args=(group,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """This process ends by itself; the last beat is when all do."""
        self._ended.set()

    def _beat(self, group: distributed.ProcessGroup) -> None:
        try:
            while True:
                all_end = torch.tensor(int(self._ended.is_set()))
                distributed.all_reduce(all_end, distributed.ReduceOp.MIN, group)
                if all_end:
                    return
                self._ended.wait(self.every)
        except RuntimeError:
            if self._ended.wait(GRACE):  # the training heard of it, too, and ends with words of its own
                return
        saved = describe(last_checkpoint(self.run))
        print(f"error: {gone()} {saved} The same command goes on.", file=sys.stderr, flush=True)
        os._exit(1)
