"""Count, skip and report steps whose gradients are not finite."""

from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_warn
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from nerfdiff.errors import TrainingDiverged


class NonFiniteGuard(Callback):
    """Logs the gradient norm; skips the update of a step whose gradients hold NaN or infinity, and says so.

    A non-finite loss gives non-finite gradients, so one check catches both.

    Args:
        patience: consecutive bad steps after which training stops.

    Raises:
        TrainingDiverged: `patience` bad steps in a row.
    """

    def __init__(self, patience: int):
        self.patience = patience
        self.total = 0
        self.in_a_row = 0

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        parameters = [p for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = get_total_norm([p.grad for p in parameters])
        if torch.isfinite(norm):
            self.in_a_row = 0
        else:
            self.total += 1
            self.in_a_row += 1
            rank_zero_warn(
                f"non-finite gradients at step {trainer.global_step} "
                f"({self.in_a_row} in a row, {self.total} in all): this update is skipped"
            )
            for parameter in parameters:
                parameter.grad = None  # an optimizer leaves a parameter without gradient as it is
        pl_module.log("train/grad_norm", norm)
        pl_module.log("train/nonfinite_steps", float(self.total))
        if self.in_a_row >= self.patience:
            raise TrainingDiverged(
                f"gradients were not finite for {self.in_a_row} steps in a row, up to step {trainer.global_step}. "
                "The last checkpoint is from before and is kept. Lower optimizer.lr, or use trainer.precision=32-true"
            )

    def state_dict(self) -> dict[str, Any]:
        return {"total": self.total, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.total, self.in_a_row = state_dict["total"], state_dict["in_a_row"]
