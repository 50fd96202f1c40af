"""TensorBoard's files of a training run."""

from collections.abc import Mapping

from lightning.pytorch.loggers import TensorBoardLogger


class TrainingLogger(TensorBoardLogger):
    """Write metrics under tags that show what is looked at first on top, as TensorBoard sorts them by name.

    `val/…` becomes `held-out/…`, beside the pictures of `Previews`, and the learning rate `train/lr…`. Epochs are left
    out: a training has one.
    """

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        shown = {_tag(name): value for name, value in metrics.items() if name != "epoch"}
        if shown:
            super().log_metrics(shown, step)


def _tag(name: str) -> str:
    if name.startswith("lr-"):
        return f"train/{name}"
    return name.replace("val/", "held-out/", 1) if name.startswith("val/") else name
