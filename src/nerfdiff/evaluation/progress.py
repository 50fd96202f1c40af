"""Progress over scenes: a bar on a terminal, elsewhere a line now and then."""

import logging
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from types import TracebackType

from lightning import Callback
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from nerfdiff.evaluation.distillation_bar import DistillationBar
from nerfdiff.training.callbacks.progress import duration

log = logging.getLogger(__name__)


class SceneProgress(AbstractContextManager):
    """Counts scenes, and within them the steps of a distillation.

    Args:
        name: of what is done with the scenes.
        total: number of scenes.
        every: seconds between lines where there is no terminal; None says nothing anywhere.
    """

    def __init__(self, name: str, total: int, every: float | None):
        self.name, self.total = name, total
        self._done, self._within = 0, 0.0
        self._began = self._said = time.monotonic()
        shown = every is not None and total > 0
        self._every = every if shown and not sys.stderr.isatty() else None
        columns = (
            TextColumn(name, markup=False),
            BarColumn(16),
            TimeElapsedColumn(),
            # takes the room that is left; what does not fit at its end is cut
            TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True)),
        )
        hidden = not shown or self._every is not None
        self._bar = Progress(*columns, console=Console(stderr=True), disable=hidden, expand=True)
        self._task = self._bar.add_task(self._where(), total=total)

    def __enter__(self) -> "SceneProgress":
        self._bar.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bar.stop()

    def callbacks(self, scenes: int) -> Sequence[Callback]:
        """Return callbacks for a Trainer that fits so many scenes; none without output, as they wait for the device."""
        if self._every is None and self._bar.disable:
            return ()

        def report(share: float, where: str, reached: str) -> None:
            self._within = share * scenes
            self._update(where, reached)

        return [DistillationBar(report, self._every or 0.5)]

    def advance(self, words: str) -> None:
        """Count one more scene as done."""
        self._done, self._within = self._done + 1, 0.0
        self._update(words or "done")

    def _update(self, where: str, reached: str = "") -> None:
        done, now = self._done + self._within, time.monotonic()
        left = ""
        if 0 < done < self.total:
            left = f"{duration((now - self._began) * (self.total - done) / done)} left"
        said = ", ".join(word for word in (self._where(), where, left, reached) if word)
        self._bar.update(self._task, completed=done, description=said)
        if self._every is not None and (now - self._said >= self._every or done == self.total):
            log.info("%s: %s", self.name, said)
            self._said = now

    def _where(self) -> str:
        return f"scene {min(self._done + 1, self.total)} of {self.total}" if self.total > 1 else ""
