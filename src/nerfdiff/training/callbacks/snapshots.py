"""Averages of the weights whose length is chosen after training (Karras et al. 2024, EDM2, arXiv 2312.02696, sec. 3).

Two averages with power-function profiles are kept while training runs, and saved from time to time. Any average of the
family, up to any saved step, is then a weighted sum of the snapshots (their eq. 135 and algorithm 3).
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from safetensors.torch import save_file
from torch import Tensor

from nerfdiff.averages import exponent_of
from nerfdiff.utils.files import atomic

log = logging.getLogger(__name__)


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
        self.exponents = {str(length): exponent_of(length) for length in lengths}
        self.averages: dict[str, list[Tensor]] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        parameters = list(pl_module.parameters())
        if not self.averages:
            self.averages = {length: [p.detach().clone() for p in parameters] for length in self.exponents}
        self.averages = {
            length: [value.to(p.device) for value, p in zip(values, parameters, strict=True)]
            for length, values in self.averages.items()
        }
        self._seen = trainer.global_step

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any, **kwargs: Any) -> None:
        step = trainer.global_step
        if step == self._seen:  # within an accumulation window
            return
        self._seen = step
        current = [p.detach() for p in pl_module.parameters()]
        for length, exponent in self.exponents.items():
            # eq. 127: θ̂_t = β_t θ̂_{t-1} + (1 - β_t) θ_t with β_t = (1 - 1/t)^(γ+1)
            torch._foreach_lerp_(self.averages[length], current, 1 - (1 - 1 / step) ** (exponent + 1))
        if trainer.is_global_zero and step % self.every_n_steps == 0:
            self._save(step, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero and self._seen and self._seen % self.every_n_steps:
            self._save(self._seen, pl_module)

    def _save(self, step: int, pl_module: LightningModule) -> None:
        names = [name.removeprefix("model.") for name, _ in pl_module.named_parameters()]
        for length, values in self.averages.items():
            state = {n: v.to("cpu", torch.float16).contiguous() for n, v in zip(names, values, strict=True)}
            with atomic(self.folder / f"step_{step:07d}_{length}.safetensors") as temporary:
                save_file(state, temporary, {"step": str(step), "length": length})

    def state_dict(self) -> dict[str, Any]:
        return {"averages": self.averages}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.averages = state_dict["averages"]
