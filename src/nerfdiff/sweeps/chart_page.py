"""The page of quality against speed at the end of a sweep: a Hydra callback."""

import logging
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerfdiff.utils.errors import UserError

log = logging.getLogger(__name__)


class SweepChart(Callback):
    """Writes what `src/chart.py results=<the sweep's folder>` would, when the sweep ends."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        from nerfdiff.chart.build import build_chart  # with pandas and plotly: not for every job
        from nerfdiff.cli import load_config

        try:
            chart = load_config("chart", [])
            chart.results = str(config.hydra.sweep.dir)
            build_chart(chart)
        except UserError as error:
            log.error("the sweep's chart: %s", error)
