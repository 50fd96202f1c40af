"""A run's settings, on disk."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer
from omegaconf import DictConfig, OmegaConf

from nerfdiff.utils.files import write_text


class Record(Callback):
    """Writes them when training begins, so that a run that is refused leaves those of the run before."""

    def __init__(self, cfg: DictConfig, path: Path):
        self.cfg, self.path = cfg, path

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero:
            write_text(self.path, OmegaConf.to_yaml(self.cfg, resolve=True))
