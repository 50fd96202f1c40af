"""The verdicts at the end of sweep=stability: Hydra callbacks."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerfdiff.metrics.summary import write_csv
from nerfdiff.results.frame import Run
from nerfdiff.results.intervals import Bootstrap
from nerfdiff.stability.breaking import Rules
from nerfdiff.stability.silent import COLUMNS, silent_failures, silent_markdown, worst_of_each
from nerfdiff.stability.study import Study, studies
from nerfdiff.stability.text import to_markdown, training_markdown
from nerfdiff.stress.axes import stress_files
from nerfdiff.sweeps.jobs import jobs_of, results_of
from nerfdiff.sweeps.stress_space import severities_of
from nerfdiff.utils.errors import UserError
from nerfdiff.utils.files import write_text

log = logging.getLogger(__name__)

VERDICTS, SILENT, PICTURES = "stability.md", "silent.csv", "silent.png"


class StabilityTable(Callback):
    """Writes stability.md into the sweep's folder at its end: breaking points, areas; and its silent failures.

    Args:
        rules: when a strategy is broken.
        bootstrap: of the intervals.
    """

    def __init__(self, rules: Rules, bootstrap: Bootstrap):
        self.rules, self.bootstrap = rules, bootstrap

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            folder = Path(config.hydra.sweep.dir)
            jobs = jobs_of(config, results_of(config))
            runs = [Run(job.row, folder) for job in jobs if job.row is not None]
            waiting = [" ".join(job.overrides[:3]) for job in jobs if job.row is None]
            found = write_verdicts(folder, runs, self.rules, self.bootstrap, waiting, left_out(config))
            for study in found:
                log.info("silent failures: %d of %d broken scenes", study.silent, study.broken)
            log.info("verdicts: %s   page: python src/chart.py results=%s", folder / VERDICTS, folder)
        except UserError as error:
            log.error("the sweep's verdicts: %s", error)


def write_verdicts(
    folder: Path,
    runs: Sequence[Run],
    rules: Rules,
    bootstrap: Bootstrap,
    waiting: Sequence[str] = (),
    left_out: Sequence[str] = (),
) -> list[Study]:
    """Write stability.md, and silent.csv and silent.png with the silent failures.

    Raises:
        DataError: files of the runs are damaged, or none can be written.
    """
    from nerfdiff.sweeps.silent_sheet import silent_sheet  # slow to import: not before a sweep's jobs

    found = studies(runs, stress_files(), rules, bootstrap)
    silent = [each for study in found for each in silent_failures(study)]
    said = f"\n## Silent failures\n\n{silent_markdown(silent, rules)}" if silent else ""
    write_text(folder / VERDICTS, to_markdown(found, waiting, left_out) + said)
    write_csv(folder / SILENT, list(COLUMNS), [each.line() for each in silent])
    if silent_sheet(folder / PICTURES, worst_of_each(silent)) is None:
        (folder / PICTURES).unlink(missing_ok=True)
    return found


def left_out(config: DictConfig) -> list[str]:
    """Say what a sweep leaves out: of the axes that it could do, severities without their folders, and all else."""
    said = []
    for axis, stress in stress_files().items():
        if stress.where == "distill":
            _, missing = severities_of(stress, config, "severities")
            said += [f"{axis} at {severity:g}: there is no {folder}" for severity, folder in missing.items()]
            said += [f"{axis}: {stress.left_out}"] if stress.left_out else []
    return said


class TrainingStability(Callback):
    """Writes stability.md of short training runs: held-out error, spikes, steps without a gradient, recovery.

    A run that failed is a row, and no longer ends the sweep.
    """

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        try:
            _ = job_return.return_value
        except Exception as error:  # its row says so
            log.error("this job of the sweep failed: %s", error)
            job_return.status, job_return.return_value = JobStatus.COMPLETED, None

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            folder = Path(config.hydra.sweep.dir)
            jobs = jobs_of(config, results_of(config))
            text = training_markdown([job.row for job in jobs if job.row is not None], stress_files())
            write_text(folder / VERDICTS, text)
            log.info("verdicts: %s", folder / VERDICTS)
        except UserError as error:
            log.error("the sweep's verdicts: %s", error)
