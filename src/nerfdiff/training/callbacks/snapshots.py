"""Averages of the weights whose length is chosen after training (Karras et al. 2024, EDM2, arXiv 2312.02696, sec. 3).

Two averages with power-function profiles are kept while training runs, and saved from time to time. Any average of the
family, up to any saved step, is then a weighted sum of the snapshots (their eq. 135 and algorithm 3).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from nerfdiff.averages import PowerAverages


class Snapshots(Callback):
    """Keeps one power-function average per length, and writes them as `step_<n>_<length>.safetensors` (fp16).

    Args:
        folder: of the files.
        every_n_steps: optimizer steps from one snapshot to the next; the last step is always one.
        lengths: relative standard deviations σ_rel of the averages, shares of the training so far (EDM2: 0.05, 0.1;
            arXiv 2312.02696).

    Raises:
        ConfigError: a length that no average has.
    """

    def __init__(self, folder: str, every_n_steps: int, lengths: Sequence[float]):
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.averages = PowerAverages(lengths)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        parameters = list(pl_module.parameters())
        for length, values in self.averages.values.items():  # of a checkpoint, on the CPU
            self.averages.values[length] = [v.to(p.device) for v, p in zip(values, parameters, strict=True)]
        self._seen = trainer.global_step

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any, **kwargs: Any) -> None:
        step = trainer.global_step
        if step == self._seen:  # within an accumulation window
            return
        self._seen = step
        self.averages.update(list(pl_module.parameters()), step)
        if trainer.is_global_zero and step % self.every_n_steps == 0:
            self._save(pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero and self._seen and self._seen % self.every_n_steps:
            self._save(pl_module)

    def _save(self, pl_module: LightningModule) -> None:
        names = [name.removeprefix("model.") for name, _ in pl_module.named_parameters()]
        self.averages.save(self.folder, names, self._seen)

    def state_dict(self) -> dict[str, Any]:
        return {"averages": self.averages.values}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.averages.values = state_dict["averages"]
