"""Count, skip and report steps whose gradients are not finite, and keep a record of how calm the others were."""

import math
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from nerfdiff.training.callbacks.stability import Stability
from nerfdiff.utils.errors import TrainingDiverged


class NonFiniteGuard(Callback):
    """Logs the gradient norm; skips the update of a step whose gradients hold NaN or infinity, and says so.

    A non-finite loss gives non-finite gradients, so one check catches both. Checkpoints carry what `Stability` says
    of the run up to them as `stability`; of several processes, each sees its own share of the loss.

    Args:
        patience: consecutive bad steps after which training stops.
        spike, memory: see `Stability`.

    Raises:
        TrainingDiverged: `patience` bad steps in a row.
    """

    def __init__(self, patience: int, spike: float, memory: int):
        self.patience = patience
        self.in_a_row = 0
        self.stability = Stability(spike, memory)
        self._loss: Tensor | float = 0.0

    @property
    def upset(self) -> int:
        """Number of steps in a row, up to the last, that failed, see `Stability`."""
        return self.stability.upset

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        self._loss = self._loss + loss.detach()  # of one step's accumulated batches, each its share

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        parameters = [p for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = get_total_norm([p.grad for p in parameters])
        # the host waits once for both
        seen, loss = torch.stack([norm.float(), torch.as_tensor(self._loss, device=norm.device).float()]).tolist()
        self.stability.add(seen, loss)
        self._loss = 0.0
        if math.isfinite(seen):
            self.in_a_row = 0
        else:
            self.in_a_row += 1
            rank_zero_warn(
                f"non-finite gradients at step {trainer.global_step} "
                f"({self.in_a_row} in a row, {self.stability.nonfinite} in all): this update is skipped"
            )
            for parameter in parameters:
                parameter.grad = None  # an optimizer leaves a parameter without gradient as it is
        pl_module.log("train/grad_norm", norm)
        pl_module.log("train/nonfinite_steps", float(self.stability.nonfinite))
        pl_module.log("train/loss_spikes", float(self.stability.spikes))
        if self.in_a_row >= self.patience:
            raise TrainingDiverged(
                f"gradients were not finite for {self.in_a_row} steps in a row, up to step {trainer.global_step}. "
                "Lower optimizer.lr, or use trainer.precision=32-true"
            )

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint["stability"] = self.stability.summary()

    def state_dict(self) -> dict[str, Any]:
        return {"in_a_row": self.in_a_row, "stability": self.stability.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.in_a_row = state_dict["in_a_row"]
        if "stability" in state_dict:  # not in runs that were begun before it was recorded
            self.stability.load_state_dict(state_dict["stability"])
