"""Configurations proposed by Optuna, from what those before them measured: it searches along the frontier."""

import math
import random
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from statistics import fmean
from typing import TYPE_CHECKING

from nerfdiff.metrics.table import METRICS
from nerfdiff.results.row import ResultRow
from nerfdiff.sweeps.proposals import Tried
from nerfdiff.sweeps.space import Axis, Configuration, Space
from nerfdiff.utils.errors import ConfigError

if TYPE_CHECKING:
    import optuna

BRANCH = "branch"

TRIES = 10
"""Proposals asked for in place of each that has been tried before, until one is drawn at random."""


@dataclass(frozen=True)
class Optuna:
    """Multi-objective tree-structured Parzen estimation (Optuna's TPESampler).

    A sweep that goes on tells it all rows of the sweep's configurations that there are.

    Args:
        configurations: how many, those of earlier runs of the sweep included.
        startup: how many of them are drawn at random, before there is anything to learn from.
        seed: of all draws.
        objectives: metrics, to be better, and other fields of `ResultRow`, to be less; of a timing it is the median.
            Each is the mean over the seeds.

    Raises:
        ConfigError: a value is out of range, or Optuna is not installed.
    """

    configurations: int
    startup: int
    seed: int
    objectives: Sequence[str]

    def __post_init__(self):
        where = "hydra.sweeper.proposals"
        if self.configurations < 1 or self.startup < 1:
            raise ConfigError(f"{where}: configurations and startup must be at least 1")
        known = {field.name for field in fields(ResultRow)}
        if unknown := [name for name in self.objectives if name not in known | METRICS.keys()]:
            raise ConfigError(f"{where}.objectives: {unknown[0]} is no metric and no field of a result row")
        if not self.objectives:
            raise ConfigError(f"{where}.objectives is empty")
        try:
            import optuna  # noqa: F401
        except ImportError as error:
            raise ConfigError("hydra/sweeper/proposals=optuna needs Optuna: pip install optuna") from error

    def known(self, space: Space, tried: Tried) -> list[Configuration]:
        """Those of earlier runs, of which some may have seeds to do."""
        return list(tried)

    def more(self, space: Space, tried: Tried, size: int) -> list[Configuration]:
        size = min(size, self.configurations - len(tried), len(space) - len(tried))
        if size < 1:
            return []
        space = space.untried(tried)  # else a small branch on the frontier is proposed again and again
        study, new = self._study(space, tried), {}
        for _ in range(TRIES * size):
            trial = study.ask()
            configuration = _asked(space, trial)
            if configuration in tried or configuration in new:
                study.tell(trial, state=_states().FAIL)
            else:
                new[configuration] = None
            if len(new) == size:
                break
        rng = random.Random(self.seed + len(tried))
        while len(new) < size:
            configuration = space.draw(rng)
            if configuration not in tried:
                new[configuration] = None
        return list(new)

    def _study(self, space: Space, tried: Tried) -> "optuna.Study":
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            sampler = optuna.samplers.TPESampler(
                n_startup_trials=self.startup,
                multivariate=True,
                group=True,  # strategies have axes of their own
                constant_liar=True,  # the proposals of one batch are to differ
                seed=self.seed + len(tried),  # with one seed every batch would begin with the same draws
            )
        study = optuna.create_study(directions=[_direction(name) for name in self.objectives], sampler=sampler)
        for configuration, rows in tried.items():
            if (number := space.branch_of(configuration)) is not None:
                study.add_trial(self._trial(space, number, configuration, rows))
        return study

    def _trial(
        self, space: Space, number: int, configuration: Configuration, rows: Sequence[ResultRow]
    ) -> "optuna.trial.FrozenTrial":
        import optuna

        several = [
            (axis, word) for axis, word in zip(space.branches[number], configuration, strict=True) if axis.varies
        ]
        values = self._values([row for row in rows if row.status == "ok"])
        return optuna.trial.create_trial(
            params={BRANCH: number} | {_name(axis): word for axis, word in several},
            distributions={
                name: optuna.distributions.CategoricalDistribution(options)
                for name, options in [(BRANCH, range(len(space.branches))), *((_name(a), a.words) for a, _ in several)]
            },
            values=values,
            state=_states().FAIL if values is None else _states().COMPLETE,
        )

    def _values(self, rows: Sequence[ResultRow]) -> list[float] | None:
        """The objectives; None where no seed succeeded, or one measured nothing finite."""
        values = [[_number(row, name) for row in rows] for name in self.objectives]
        means = [fmean(of_seeds) for of_seeds in values if of_seeds]
        return means if means and all(map(math.isfinite, means)) else None


def _asked(space: Space, trial: "optuna.Trial") -> Configuration:
    branch = space.branches[trial.suggest_categorical(BRANCH, range(len(space.branches)))]
    return tuple(
        trial.suggest_categorical(_name(axis), axis.words) if axis.varies else axis.words[0] for axis in branch
    )


def _name(axis: Axis) -> str:
    """Optuna's name of an axis: an axis with fewer choices in another branch is another one to it."""
    return " ".join(axis.words)


def _states() -> type["optuna.trial.TrialState"]:
    import optuna

    return optuna.trial.TrialState


def _direction(name: str) -> str:
    return "maximize" if name in METRICS and METRICS[name].sign > 0 else "minimize"


def _number(row: ResultRow, name: str) -> float:
    value = row.measured(name)
    if value is None:
        raise ConfigError(f"hydra.sweeper.proposals.objectives: {name} was not measured; choose another")
    return float(value["median"] if isinstance(value, dict) else value)
