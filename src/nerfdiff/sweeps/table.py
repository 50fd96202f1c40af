"""The table at the end of a sweep: a Hydra callback."""

import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from rich.console import Console

from nerfdiff.results.intervals import Bootstrap
from nerfdiff.sweeps.frontier import Frontier
from nerfdiff.sweeps.jobs import Group, group, jobs_of, results_of
from nerfdiff.sweeps.lines import Line, lines_of
from nerfdiff.sweeps.text import to_csv, to_markdown, to_rich
from nerfdiff.utils.errors import UserError
from nerfdiff.utils.files import write_text

log = logging.getLogger(__name__)

TABLE = "table.csv"


class SweepTable(Callback):
    """Writes table.csv and table.md into the sweep's folder while it runs, and grid.png and orbits.mp4 at the end.

    The jobs of the command are the table: each with the newest row that it left in the sweep's results, so that a
    sweep that goes on after it was killed has every job once. A job without a row is there as `not run`.

    Args:
        labels: keys of overrides that tell the table's rows apart; others that the command sweeps over are added.
        reference, goal, paper: see `lines_of`.
        bootstrap: of the intervals.
        frontier: pictures and terminal show the lines on it alone; None has them show all lines.
        show: whether the terminal and pictures show the lines.
        pause: seconds between two writings of the table while the sweep runs.
    """

    def __init__(
        self,
        labels: Sequence[str],
        reference: Mapping[str, str],
        goal: Mapping[str, str],
        paper: Sequence[Mapping[str, Any]],
        bootstrap: Bootstrap,
        frontier: Frontier | None,
        pause: float,
        show: bool,
    ):
        self.labels, self.reference, self.goal = labels, reference, goal
        self.paper, self.bootstrap, self.frontier, self.pause = paper, bootstrap, frontier, pause
        self.show = show
        self.sweep: DictConfig | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        self.sweep = config

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """A failure that the job did not record itself becomes a row, and no longer ends the sweep without a table."""
        if self.sweep is None:  # one job of a sweep, run by itself
            return
        try:
            _ = job_return.return_value
        except Exception as error:
            log.exception("this job of the sweep failed")
            job_return.status, job_return.return_value = JobStatus.COMPLETED, None
            self._told(partial(self._record, config, error))
        if time.time() - self._written >= self.pause:
            self._told(self._write)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Hydra lets no Exception of a callback end the command: without a table, or any success, it is an exit."""
        try:
            groups, lines, notes = self._write()
        except Exception as error:
            why = f"{'' if isinstance(error, UserError) else f'{type(error).__name__}: '}{error}"
            raise SystemExit(f"error: this sweep's table could not be written: {why}") from error
        self._show(groups, lines, notes)

    @property
    def _written(self) -> float:
        """When, in seconds since the epoch; jobs side by side in several processes share the file alone."""
        path = Path(self.sweep.hydra.sweep.dir) / TABLE
        return path.stat().st_mtime if path.is_file() else 0.0

    def _told(self, work: Callable[[], object]) -> None:
        try:
            work()
        except UserError as error:
            log.error("the sweep's table: %s", error)

    def _record(self, config: DictConfig, error: Exception) -> None:
        from nerfdiff.evaluation.measure import record_failure  # imports PyTorch: not for who only launches jobs

        overrides = set(config.hydra.overrides.task)
        if not any(job.row for job in jobs_of(self.sweep) if set(job.overrides) == overrides):
            record_failure(config, error, None, None)

    def _write(self) -> tuple[list[Group], list[Line], list[str]]:
        file = results_of(self.sweep)
        groups = group(jobs_of(self.sweep, file), self.labels)
        lines = lines_of(groups, self.bootstrap, self.reference, self.goal, self.paper)
        if self.frontier is not None:
            lines = self.frontier(groups, lines)
        notes = [str(file.skipped)] if file.skipped.lines else []
        folder = Path(self.sweep.hydra.sweep.dir)
        write_text(folder / TABLE, to_csv(lines))
        write_text(folder / "table.md", to_markdown(lines, notes))
        return groups, lines, notes

    def _show(self, groups: Sequence[Group], lines: Sequence[Line], notes: Sequence[str]) -> None:
        folder = Path(self.sweep.hydra.sweep.dir)
        shown = [number for number, line in enumerate(lines) if line.frontier or self.frontier is None]
        if shown and self.show:
            console = Console(width=None if sys.stdout.isatty() else 200)
            console.print(to_rich([lines[number] for number in shown], notes))
        if not any(line.seeds for line in lines):
            raise SystemExit(f"error: no job of this sweep succeeded; {folder / 'table.md'} says why")
        if not self.show:
            log.info("table: %s and .csv", folder / "table.md")
            return
        try:
            left = self._pictures(folder, [groups[number] for number in shown])
        except Exception as error:  # of whatever reads the jobs' pictures and videos
            log.error("the sweep's pictures: %s", error)
            left = "none"
        log.info("table: %s and .csv   pictures: %s", folder / "table.md", left)

    def _pictures(self, folder: Path, groups: Sequence[Group]) -> str:
        from nerfdiff.sweeps.grid import grid
        from nerfdiff.sweeps.orbits import orbits

        pictures = [
            grid(folder / "grid.png", self.sweep, groups),
            orbits(folder / "orbits.mp4", groups, self.sweep.orbit),
        ]
        return ", ".join(str(picture) for picture in pictures if picture) or "none"
