"""A training run in TensorBoard: what it is, as text and hyperparameters, and a first screen that shows how it goes."""

from collections.abc import Sequence
from pathlib import Path

import yaml
from hydra.core.hydra_config import HydraConfig
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from nerfdiff.results import tensorboard
from nerfdiff.results.tensorboard import Layout


class Dashboard(Callback):
    """Makes the run a line of the HPARAMS tab, with the last value of each of its scalars as metrics.

    Args:
        config: the file that the run's settings were written to.
        hparams: keys of settings that tell runs apart, beside those that the command gave, and their `kind`.
        ignored: keys of settings that do not, or what they begin with.
        layout: of the custom scalars tab.
    """

    def __init__(self, config: str, hparams: Sequence[str], ignored: Sequence[str], layout: Layout):
        self.config, self.hparams, self.ignored, self.layout = Path(config), hparams, ignored, layout

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for writer in _writers(trainer):
            text = self.config.read_text(encoding="utf-8")
            settings = yaml.safe_load(text)
            values = {"kind": "training"} | {key: _at(settings, key) for key in self.hparams}
            if HydraConfig.initialized():
                values |= tensorboard.overridden(HydraConfig.get().overrides.task, self.ignored)
            texts = {"about": tensorboard.table(values), "config": tensorboard.code(text, "yaml")}
            tensorboard.begin(writer, values, texts, self.layout)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for writer in _writers(trainer):
            tensorboard.end(writer, succeeded=True)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if not isinstance(exception, Exception):
            return  # Ctrl-C or a scheduler: the run will go on
        for writer in _writers(trainer):
            tensorboard.end(writer, succeeded=False)


def _writers(trainer: Trainer) -> list[SummaryWriter]:
    """Return this process's TensorBoard writers."""
    if not trainer.is_global_zero:
        return []
    return [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


def _at(settings: dict, key: str) -> object:
    """Return a nested setting by its dotted key; None where there is none."""
    for name in key.split("."):
        settings = settings.get(name) if isinstance(settings, dict) else None
    return settings
