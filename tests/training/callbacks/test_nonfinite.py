import math

import pytest
import torch
from lightning import LightningModule, Trainer
from torch.utils.data import DataLoader

from nerfdiff.training.callbacks.nonfinite import NonFiniteGuard
from nerfdiff.utils.errors import TrainingDiverged


class Sometimes(LightningModule):
    """Its loss is not finite at chosen steps."""

    def __init__(self, bad: dict[int, float]):
        super().__init__()
        self.layer, self.bad, self.history = torch.nn.Linear(1, 1), bad, []
        self.bias = self.layer.bias.item()

    def training_step(self, batch, batch_idx):
        self.history.append(self.layer.weight.item())
        return self.layer(batch).square().mean() * self.bad.get(batch_idx, 1.0)

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.1)


def guard_with(patience):
    return NonFiniteGuard(patience, spike=3.0, memory=3)


def fit(module, guard):
    options = {"logger": False, "enable_progress_bar": False, "enable_checkpointing": False}
    run = Trainer(accelerator="cpu", max_epochs=1, enable_model_summary=False, callbacks=[guard], **options)
    run.fit(module, DataLoader(torch.ones(8, 1), batch_size=1))
    return run


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_bad_step_changes_nothing_and_is_counted(value):
    module, guard = Sometimes({2: value, 5: value}), guard_with(2)
    with pytest.warns(UserWarning, match="non-finite gradients at step 2"):
        run = fit(module, guard)
    assert guard.stability.nonfinite == 2
    assert run.callback_metrics["train/nonfinite_steps"] == 2
    weights = module.history
    assert weights[3] == weights[2] and weights[6] == weights[5]
    assert weights[4] != weights[3] and math.isfinite(weights[7])


def test_bad_steps_in_a_row_stop_the_run():
    module, guard = Sometimes({3: math.nan, 4: math.nan, 5: math.nan}), guard_with(3)
    with pytest.raises(TrainingDiverged, match="3 steps in a row"):
        fit(module, guard)
    assert len(module.history) == 6


def test_the_counts_survive_a_resume():
    module, guard = Sometimes({5: 100.0, 7: math.nan}), guard_with(5)
    with pytest.warns(UserWarning, match="non-finite gradients at step 7"):
        run = fit(module, guard)
    again = guard_with(5)
    again.load_state_dict(guard.state_dict())
    assert again.in_a_row == 1
    assert again.stability.summary() == guard.stability.summary() | {"nonfinite_grad_steps": 1, "loss_spikes": 1}
    assert run.callback_metrics["train/loss_spikes"] == 1
    checkpoint = {}
    again.on_save_checkpoint(run, module, checkpoint)
    assert checkpoint == {"stability": guard.stability.summary()}


def test_accumulated_batches_are_one_loss():
    """Each of the two batches of a step has half of what is compared with the mean."""
    module, guard = Sometimes({}), guard_with(5)
    seen = []
    guard.stability.add = lambda norm, loss: seen.append(loss)
    options = {"logger": False, "enable_progress_bar": False, "enable_checkpointing": False}
    run = Trainer(accelerator="cpu", max_epochs=1, accumulate_grad_batches=2, callbacks=[guard], **options)
    run.fit(module, DataLoader(torch.tensor([[1.0], [3.0]]), batch_size=1))
    weight, bias = module.history[0], module.bias
    assert seen == [pytest.approx(((weight + bias) ** 2 + (3 * weight + bias) ** 2) / 2, rel=1e-5)]


def test_the_gradient_norm_is_that_of_all_parameters_together():
    module, guard = Sometimes({}), guard_with(5)
    run = fit(module, guard)
    gradients = [p.grad for p in module.parameters()]
    expected = math.sqrt(sum(float(g.square().sum()) for g in gradients))
    assert float(run.callback_metrics["train/grad_norm"]) == pytest.approx(expected, rel=1e-5)
