"""One sweep from its first batch of jobs to its last, on whatever launcher."""

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, get_valid_filename
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, open_dict

from nerfdiff.results.row import RESULTS, ResultRow, RowFile
from nerfdiff.sweeps.cluster import JobDied, every_result
from nerfdiff.sweeps.jobs import results_of
from nerfdiff.sweeps.plan import write_plan
from nerfdiff.sweeps.proposals import Proposals
from nerfdiff.sweeps.space import Configuration, Space
from nerfdiff.sweeps.task import Task
from nerfdiff.utils.hashes import sha256_values

log = logging.getLogger(__name__)

NUMBER = re.compile(r"=[\d.,e+/-]+$")  # of an override; a shard's, too
DEATHS = 5
"""Jobs that, each by itself, take their process along, while none ever came back, until the launcher is to blame."""

Job = tuple[str, ...]
"""The overrides of a configuration and, where it is swept over, of a seed."""


@dataclass
class Run:
    """The jobs of a space that have no row yet, handed to a launcher in batches.

    What a job measured is what its row in the sweep's file of results says; a job that died without one is given one.

    Args:
        config: of the sweep, with Hydra's node.
        load: `config` and the overrides of a job to the job's config.
        batch_size: configurations handed to the launcher at once; None is all.
        retry: whether jobs that failed in an earlier run are run again.
    """

    config: DictConfig
    space: Space
    proposals: Proposals
    launcher: Launcher
    load: Callable[[DictConfig, list[str]], DictConfig]
    task: Task
    batch_size: int | None
    retry: bool
    launched: int = 0
    deaths: int = 0
    attempted: set[Job] = field(default_factory=set)
    failures: list[str] = field(default_factory=list)
    results: RowFile = field(init=False)

    def __post_init__(self):
        self.results = results_of(self.config)

    def __call__(self) -> list[JobReturn]:
        """Run what is to do, until nothing is left or the time is up.

        Raises:
            DataError: the file of results cannot be read, or has rows of another schema alone.
            CompactHydraException: jobs failed and no callback of the sweep took note of it.
        """
        known = dict.fromkeys(self.proposals.known(self.space, self._tried()))
        returns: list[JobReturn] = []
        while True:
            write_plan(self._folder, [job for configuration in known for job in self._jobs(configuration)])
            for batch in self._batches(known):
                if self.task.late:
                    break
                self._validate(batch)
                returns += self._launch(batch)
            if self.task.late:
                break
            size = self.batch_size or len(known) + 1
            more = [new for new in self.proposals.more(self.space, self._tried(), size) if new not in known]
            if not more:
                break
            known |= dict.fromkeys(more)
        self._report(known)
        if self.failures:
            raise CompactHydraException(f"{len(self.failures)} jobs failed: {'; '.join(self.failures)}")
        return returns

    @property
    def _folder(self) -> Path:
        return Path(self.config.hydra.sweep.dir)

    def _jobs(self, configuration: Configuration) -> list[Job]:
        return [(*configuration, seed) for seed in self.space.seeds] or [configuration]

    def _rows(self) -> dict[frozenset[str], list[ResultRow]]:
        """All rows of a job, oldest first, by its overrides."""
        rows: dict[frozenset[str], list[ResultRow]] = {}
        for row in self.results.read() if self.results.path.exists() else ():
            rows.setdefault(frozenset(row.overrides or ()), []).append(row)
        return rows

    def _tried(self) -> dict[Configuration, list[ResultRow]]:
        tried: dict[Configuration, list[ResultRow]] = {}
        for words, rows in self._rows().items():
            if (configuration := self.space.find(words)) is not None:
                tried.setdefault(configuration, []).append(rows[-1])
        return tried

    def _batches(self, known: Iterable[Configuration]) -> Iterable[list[Job]]:
        """Batch the jobs still to do of known configurations; all seeds of one are in the same batch."""
        rows = self._rows()
        to_do = [[job for job in self._jobs(configuration) if self._to_do(job, rows)] for configuration in known]
        to_do = [jobs for jobs in to_do if jobs]
        size = self.batch_size or max(1, len(to_do))
        for start in range(0, len(to_do), size):
            yield [job for jobs in to_do[start : start + size] for job in jobs]

    def _to_do(self, job: Job, rows: dict[frozenset[str], list[ResultRow]]) -> bool:
        statuses = [row.status for row in rows.get(frozenset(job), ())]
        return job not in self.attempted and "ok" not in statuses and (self.retry or not statuses)

    def _words(self, job: Job) -> list[str]:
        """A job's overrides with a folder of its own, the same whenever the sweep goes on."""
        seed = [word.replace("=", "") for word in job if word in self.space.seeds]
        digest = sha256_values(sorted(set(job) - set(self.space.seeds)))[:8]
        name = "-".join([*self.space.named(job), digest, *seed])
        return [*job, f"hydra.sweep.subdir={get_valid_filename(name)}"]

    def _validate(self, batch: Sequence[Job]) -> None:
        """Raises what Hydra raises of a job that cannot be composed, before the batch begins.

        Of jobs that differ in numbers alone, as in the seed, one tells of all: an array has thousands of them.
        """
        for job in {tuple(NUMBER.sub("=", word) for word in job): job for job in batch}.values():
            self.load(self.config, self._words(job))

    def _launch(self, batch: Sequence[Job], again: bool = False) -> list[JobReturn]:
        """Run a batch. Where the launcher itself fails, a job took its process along: then one job after the other.

        Jobs of a cluster that died without leaving a row are run `again`, together and once.
        """
        before = self._rows()
        self.attempted.update(batch)
        try:
            with every_result(self.launcher):
                results = self.launcher.launch([self._words(job) for job in batch], initial_job_idx=self.launched)
        except Exception as error:
            if len(batch) == 1:
                self._record(batch[0], error)
                self.deaths += 1
                if self.deaths >= DEATHS and not self.launched:
                    raise
                return []
            log.exception("the launcher failed; each job of this batch that left no row is run by itself")
            returns = []
            for job in batch:
                if len(self._rows().get(frozenset(job), ())) == len(before.get(frozenset(job), ())):
                    returns += self._launch([job])
            return returns
        self.launched += len(batch)
        died: dict[Job, Exception] = {}
        for job, result in zip(batch, results, strict=True):
            try:
                _ = result.return_value
            except JobDied as error:
                died[job] = error
            except Exception as error:
                self.failures.append(f"{' '.join(set(job) & self.space.varied)} ({error})")
        rows = self._rows()
        lost = [job for job in died if len(rows.get(frozenset(job), ())) == len(before.get(frozenset(job), ()))]
        returns = [result for job, result in zip(batch, results, strict=True) if job not in lost]
        if lost and not again:
            log.warning("%d of %d jobs died and are run again: %s", len(lost), len(batch), died[lost[0]])
            return returns + self._launch(lost, again=True)
        for job in lost:
            self._record(job, died[job])
        return returns

    def _record(self, job: Job, error: Exception) -> None:
        """A row for a job whose process is gone."""
        # they import PyTorch, which this process may not need
        from nerfdiff.evaluation.measure import record_failure
        from nerfdiff.training.rows import append_training_row

        log.error("this job of the sweep ended with its process: %s", " ".join(job))
        config = self.load(self.config, self._words(job))
        with open_dict(config.hydra.runtime):
            config.hydra.runtime.output_dir = str((self._folder / config.hydra.sweep.subdir).absolute())
        HydraConfig.instance().set_config(config)
        try:
            if "strategy" in config:
                record_failure(config, error, None, None)
            else:  # of train.py
                append_training_row(config, None, error)
        finally:
            HydraConfig.instance().set_config(self.config)

    def _report(self, known: Iterable[Configuration]) -> None:
        rows = self._rows()
        newest = [
            rows[frozenset(job)][-1].status if frozenset(job) in rows else "not run"
            for configuration in known
            for job in self._jobs(configuration)
        ]
        counts = ", ".join(f"{count} {status}" for status, count in Counter(newest).most_common())
        log.info("%d jobs of this sweep: %s; rows in %s", len(newest), counts or "none", self._folder / RESULTS)
        if self.task.late and "not run" in newest:
            log.info("the minutes are spent; the same command goes on")
