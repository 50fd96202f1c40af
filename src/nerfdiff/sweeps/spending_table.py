"""What scenes were given in a sweep over budgets: a Hydra callback."""

import logging
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerfdiff.results.frame import Run
from nerfdiff.results.spending import write_spending
from nerfdiff.sweeps.jobs import jobs_of, results_of
from nerfdiff.utils.errors import UserError

log = logging.getLogger(__name__)


class SpendingTable(Callback):
    """Writes spending.md, spending.csv and regret.csv into the sweep's folder at its end.

    Args:
        metric: of a scene's quality.
        tolerance: in its unit, within which a cheaper budget is as good.
    """

    def __init__(self, metric: str, tolerance: float):
        self.metric, self.tolerance = metric, tolerance

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        try:
            runs = [Run(job.row, folder) for job in jobs_of(config, results_of(config)) if job.row is not None]
            log.info("spending: %s", write_spending(folder, runs, self.metric, self.tolerance))
        except UserError as error:
            log.error("the sweep's spending: %s", error)
