"""Fields of a few steps of distillation, for people to look at."""

from lightning import Callback, LightningModule, Trainer

from nerfdiff.fit.refined_field import RefinedField


class KeptSteps(Callback):
    """Keep copies of the fields before the first step, and evenly on; the last field is the result, and not among them.

    Args:
        count: of copies of each scene's field.
    """

    def __init__(self, count: int):
        self.count = count
        self.fields: list[dict[int, RefinedField]] = []
        """By scenes: the fields by how many steps had been done, on the CPU. Fields with NaN are left out."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.fields = [{} for _ in range(len(pl_module.field))]
        self._wanted = {number * pl_module.steps // self.count for number in range(self.count)}
        self._keep(pl_module, 0)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int) -> None:
        if batch_idx + 1 < pl_module.steps:
            self._keep(pl_module, batch_idx + 1)

    def _keep(self, module: LightningModule, done: int) -> None:
        if done not in self._wanted:
            return
        for scene, finite in enumerate(module.field.finite().tolist()):
            if finite:
                self.fields[scene][done] = module.field.alone(scene).to("cpu").requires_grad_(False)
