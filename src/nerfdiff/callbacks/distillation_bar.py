"""A live word on how a scene's distillation goes."""

from collections.abc import Callable

from lightning import Callback, LightningModule, Trainer


class DistillationBar(Callback):
    """Says t and how well the field's renderings agree with their targets, after every step.

    Args:
        tell: receives the words.
    """

    def __init__(self, tell: Callable[[str], None]):
        self.tell = tell

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        step = pl_module.trace[-1]
        where = f"step {batch_idx + 1}" if step.t is None else f"t {step.t:.2f}"
        agreement = "–" if step.agreement is None else f"{step.agreement:.1f} dB"
        self.tell(f"{where}, renders against targets {agreement}")
