"""Hydra takes sweepers from modules of this namespace only. Light: every command of every Hydra program imports it."""

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.plugins import Plugins
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    from nerfdiff.sweeps.proposals import Proposals
    from nerfdiff.sweeps.stress_space import StressSpace
    from nerfdiff.sweeps.task import Task

log = logging.getLogger(__name__)


class BudgetedSweeper(Sweeper):
    """Some or all combinations of choices, as many as fit the time, none twice.

    A job that has a row with status ok in the sweep's results.jsonl is not run again, so that the same command goes on
    where it stopped. The jobs go to whatever launcher is configured.

    Args:
        params: choices by key, in Hydra's syntax; those of the command line replace them.
        params_for: further ones, which hold where a config group (its name) has a choice (its name).
        proposals: which combinations.
        space: makes the configurations in place of `params_for` and `indirect`; None: `space_of` does.
        minutes: after which no job begins; None is no limit.
        batch_size: configurations handed to the launcher at once, each with all seeds; None is all of them.
        retry: whether jobs that failed when the command ran before are run again.
        indirect: see `nerfdiff.sweeps.space.space_of`.
    """

    def __init__(
        self,
        params: Mapping[str, str] | None,
        params_for: Mapping[str, Mapping[str, Mapping[str, str]]],
        proposals: "Proposals",
        space: "StressSpace | None",
        minutes: float | None,
        batch_size: int | None,
        retry: bool,
        indirect: Sequence[str],
    ):
        self.params, self.params_for, self.proposals = params or {}, params_for, proposals
        self.minutes, self.batch_size, self.retry, self.indirect = minutes, batch_size, retry, list(indirect)
        self.make_space = space
        self.config: DictConfig | None = None
        self.hydra_context: HydraContext | None = None
        self.launcher: Launcher | None = None
        self.task: Task | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from nerfdiff.sweeps.task import Task

        self.hydra_context, self.config, self.task = hydra_context, config, Task(task_function)
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=self.task, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Run the sweep that `params` and the command's overrides describe; the returns of its jobs.

        Raises:
            CompactHydraException: bad choices or numbers, damaged results, or failed jobs that no callback took note
                of. Hydra prints it as one line.
        """
        from nerfdiff.utils.errors import UserError

        try:
            return self._sweep(arguments)
        except UserError as error:
            raise CompactHydraException(f"error: {error}") from error

    def _sweep(self, arguments: list[str]) -> Any:
        from nerfdiff.sweeps.run import Run
        from nerfdiff.sweeps.space import space_of
        from nerfdiff.utils.errors import ConfigError

        for name, value in (("minutes", self.minutes), ("batch_size", self.batch_size)):
            if value is not None and value <= 0:
                raise ConfigError(f"hydra.sweeper.{name}={value} must be more than 0, or null")
        loader = self.hydra_context.config_loader
        folder = Path(self.config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")
        params = [f"{key}={value}" for key, value in self.params.items()]

        def compose(words: list[str]) -> DictConfig:
            return loader.load_sweep_config(self.config, words)

        def is_group(key: str) -> bool:
            return bool(loader.get_group_options(key))

        if self.make_space is not None:
            space = self.make_space(params, arguments, compose)
        else:
            space = space_of(params, self.params_for, arguments, compose, is_group, self.indirect)
        log.info("%d configurations in %s", len(space), folder)
        if self.minutes is not None:
            self.task.until = time.time() + 60 * self.minutes
        return Run(
            config=self.config,
            space=space,
            proposals=self.proposals,
            launcher=self.launcher,
            load=loader.load_sweep_config,
            task=self.task,
            batch_size=self.batch_size,
            retry=self.retry,
        )()
