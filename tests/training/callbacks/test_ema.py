import os
import signal

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from torch.utils.data import DataLoader

from nerfdiff.stopping import Stopped
from nerfdiff.training.callbacks.checkpoint import LastCheckpoint
from nerfdiff.training.callbacks.ema import EMA


class Line(LightningModule):
    """Fits a line; keeps the weights after every step, and the weights that validation saw."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(2, 1)
        self.history, self.validated = [self.weight()], []

    def weight(self):
        return self.layer.weight.detach().clone()

    def training_step(self, batch, batch_idx):
        return self.layer(batch).square().mean()

    def on_train_batch_end(self, *args):
        self.history.append(self.weight())

    def validation_step(self, batch, batch_idx):
        self.validated.append(self.weight())

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def loader():
    return DataLoader(torch.randn(8, 2, generator=torch.Generator().manual_seed(1)), batch_size=1)


def trainer(folder, *callbacks, **options):
    return Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        default_root_dir=folder,
        callbacks=list(callbacks),
        **options,
    )


def naive_average(history, decay, warmup):
    """The first update copies; the n-th after it keeps min(decay, (1 + n) / (warmup + n))."""
    average = history[0]
    for n, weight in enumerate(history):
        rate = min(decay, (1 + n) / (warmup + n))
        average = weight if n == 0 else rate * average + (1 - rate) * weight
    return average


@pytest.mark.parametrize(("decay", "warmup"), [(0.9999, 10), (0.5, 1)])
def test_average_equals_the_loop(tmp_path, decay, warmup):
    module, ema = Line(), EMA(decay, warmup)
    trainer(tmp_path, ema, enable_checkpointing=False).fit(module, loader())
    torch.testing.assert_close(module.weight(), naive_average(module.history[1:], decay, warmup))
    assert not torch.equal(module.weight(), module.history[-1])


def test_every_use_after_training_sees_the_average(tmp_path):
    """Lightning's own callback hands the raw weights to a test or validation from a checkpoint after `fit`."""
    module, ema = Line(), EMA(0.9, 1)
    run = trainer(tmp_path, ema, LastCheckpoint(str(tmp_path), every_n_steps=1))
    run.fit(module, loader(), loader())
    average, raw = module.weight(), module.history[-1]
    assert not torch.allclose(average, raw)
    torch.testing.assert_close(module.validated[-1], average)
    for again in (run, trainer(tmp_path, EMA(0.9, 1)), trainer(tmp_path)):
        fresh = Line()
        again.validate(fresh, loader(), ckpt_path=tmp_path / "last.ckpt", weights_only=True, verbose=False)
        torch.testing.assert_close(fresh.validated[-1], average)


class Stop(Callback):
    def on_validation_batch_start(self, *args):
        os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupted_validation_leaves_sound_weights(tmp_path):
    module = Line()
    run = trainer(tmp_path, EMA(0.9, 1), Stop(), LastCheckpoint(str(tmp_path), every_n_steps=100))
    with pytest.raises(Stopped):
        run.fit(module, loader(), loader())
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    torch.testing.assert_close(saved["current_model_state"]["layer.weight"], module.history[-1])
    torch.testing.assert_close(saved["state_dict"]["layer.weight"], naive_average(module.history[1:], 0.9, 1))
