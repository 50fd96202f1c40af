"""The jobs of a sweep, the rows they left, and which of them make one row of the sweep's table."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from nerfdiff.results.inside import inside
from nerfdiff.results.row import RESULTS, ResultRow, RowFile
from nerfdiff.sweeps.plan import read_plan
from nerfdiff.utils.errors import DataError

log = logging.getLogger(__name__)

SEED = "seed"
NOT_RUN = "not run"

Labels = dict[str, str]


@dataclass(frozen=True)
class Job:
    """One job of a sweep.

    Args:
        overrides: as its row has them.
        row: the newest that it left; None if there is none yet.
        folder: of the sweep.
        labels: the values of those overrides that tell jobs apart, the seed left out.
    """

    overrides: tuple[str, ...]
    row: ResultRow | None
    folder: Path
    labels: Labels = field(default_factory=dict)

    @property
    def status(self) -> str:
        return NOT_RUN if self.row is None else self.row.status

    def own(self, kind: str, *below: str) -> Path:
        """Its predictions or scores (`kind`), or what lies `below` these.

        Raises:
            DataError: that is not there, or outside of the sweep's folder.
        """
        row = self.row
        parts = (row.folder or "", kind, row.strategy or "", *below) if row is not None else ()
        path = inside((self.folder,), self.folder, *parts) if all(parts) and parts else None
        if path is None:
            raise DataError(f"{self.folder.joinpath(*parts)} is not there, or outside of the sweep's folder")
        return path


@dataclass(frozen=True)
class Group:
    """Jobs that differ in their seed alone, in the order of the sweep."""

    labels: Labels
    jobs: tuple[Job, ...]

    @property
    def succeeded(self) -> list[Job]:
        return [job for job in self.jobs if job.status == "ok"]

    @property
    def failed(self) -> list[Job]:
        return [job for job in self.jobs if job.status != "ok"]

    @property
    def name(self) -> str:
        return " ".join(shown(value) for value in self.labels.values())


def shown(value: str) -> str:
    """A label for people: a mapping without its braces, an empty one being the defaults."""
    return (value.replace("{", "").replace("}", "") or "defaults") if value.startswith("{") else value


def planned(sweep: DictConfig) -> list[tuple[str, ...]]:
    """The overrides of every job of a multirun: those in the plan of our sweeper, or all that Hydra's makes, in order.

    Raises:
        DataError: the plan is damaged.
    """
    if "proposals" in sweep.hydra.sweeper:
        return read_plan(Path(sweep.hydra.sweep.dir))
    # as they were typed: an interpolation in them is each job's own
    params = OmegaConf.to_container(sweep.hydra.sweeper.params or OmegaConf.create(), resolve=False)
    typed = OmegaConf.to_container(sweep.hydra.overrides.task, resolve=False)
    words = [f"{key}={value}" for key, value in params.items()]
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides([*words, *typed]):
        key = override.get_key_element()
        sweeps = override.is_discrete_sweep()
        values = override.sweep_string_iterator() if sweeps else [override.get_value_element_as_str()]
        choices[key] = [f"{key}={value}" for value in values]
    return list(product(*choices.values()))


def results_of(sweep: DictConfig) -> RowFile:
    """The rows of the sweep's jobs, as yet unread."""
    return RowFile(Path(sweep.hydra.sweep.dir) / RESULTS)


def jobs_of(sweep: DictConfig, file: RowFile | None = None) -> list[Job]:
    """Every job of the sweep with the newest row that it left in the sweep's folder.

    Args:
        file: `results_of` the sweep; it tells afterwards which lines were skipped.

    Raises:
        DataError: the file of results cannot be read, or has rows of another schema alone.
    """
    file = file or results_of(sweep)
    rows = {frozenset(row.overrides or ()): row for row in (file.read() if file.path.exists() else ())}
    return [Job(overrides, rows.get(frozenset(overrides)), file.path.parent) for overrides in planned(sweep)]


def group(jobs: Sequence[Job], keys: Sequence[str]) -> list[Group]:
    """Jobs with equal labels together, in the order in which they first appear.

    Jobs with equal digests of all that their numbers depend on did the same: they are one job, under the labels that
    they have in common.

    Args:
        keys: of overrides that are labels, first; any other of which the jobs have several values is one as well.
    """
    settings = [dict(word.lstrip("+").split("=", 1) for word in job.overrides if "=" in word) for job in jobs]
    found = dict.fromkeys([*keys, *(key for values in settings for key in values)])
    several = [key for key in found if key in keys or len({values.get(key) for values in settings}) > 1]
    distinct: dict[str | int, Job] = {}
    for number, (job, values) in enumerate(zip(jobs, settings, strict=True)):
        labels = {key: values[key] for key in several if key in values and key != SEED}
        digest = job.row.config_sha256 if job.row is not None and job.status == "ok" else None
        same = distinct.get(digest or number)
        if same is not None:
            labels = {key: value for key, value in labels.items() if same.labels.get(key) == value}
        distinct[digest or number] = replace(job, labels=labels)
    groups: dict[tuple, list[Job]] = {}
    for job in distinct.values():
        groups.setdefault(tuple(job.labels.items()), []).append(job)
    return [Group(dict(labels), tuple(members)) for labels, members in groups.items()]


def counterpart(of: Group, groups: Sequence[Group], labels: Mapping[str, str]) -> Group | None:
    """The group that has `labels`, and else those of `of`."""
    wanted = (of.labels | dict(labels)).items()
    if not labels:
        return None
    found = [other for other in groups if labels.items() <= other.labels.items() <= wanted]
    return max(found, key=lambda other: len(other.labels), default=None)


def shown_predictions(groups: Sequence[Group]) -> dict[str, Path]:
    """The folder of the first seed's predictions by the group's name, of groups that have one."""
    shown = {}
    for of in groups:
        try:
            shown.update((of.name, job.own("predictions")) for job in of.succeeded[:1])
        except DataError as error:
            log.warning("the pictures are without %s: %s", of.name, error)
    return shown
