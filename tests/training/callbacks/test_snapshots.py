import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from torch.utils.data import DataLoader

from nerfdiff.averages import average_of, combination, exponent_of, products
from nerfdiff.training.callbacks.snapshots import Snapshots
from nerfdiff.utils.errors import CheckpointError, ConfigError


class Walk(LightningModule):
    """One weight that goes a known way: 1 after the first step, 4 after the second, 9, 16, …"""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def training_step(self, batch, batch_idx):
        return (self.weight * -(2 * self.global_step + 1)).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)


def walk(folder, steps, **resume):
    snapshots = Snapshots(str(folder / "snapshots"), every_n_steps=4, lengths=[0.05, 0.1])
    trainer = Trainer(
        accelerator="cpu", max_steps=steps, callbacks=[snapshots], logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=folder,
    )  # fmt: skip
    trainer.fit(Walk(), DataLoader(torch.zeros(64), batch_size=1), **resume)
    return trainer


def profile_mean(steps: int, length: float) -> float:
    """The average of n² over steps 1 to n whose weights grow as step^γ, by the recursion's closed form."""
    exponent, mean = exponent_of(length), 0.0
    for n in range(1, steps + 1):
        mean += (n**2 - mean) * (1 - (1 - 1 / n) ** (exponent + 1))
    return mean


@pytest.mark.parametrize("length", [0.01, 0.05, 0.1, 0.25])
def test_the_exponent_gives_the_length(length):
    tau = np.linspace(0, 1, 400_001)[1:]
    weights = tau ** exponent_of(length)
    weights /= weights.sum()
    mean = (weights * tau).sum()
    assert np.sqrt((weights * (tau - mean) ** 2).sum()) == pytest.approx(length, rel=1e-3)


def test_products_are_integrals_of_profiles():
    tau = np.linspace(0, 30, 600_001)[1:]

    def profile(t, g):
        return np.where(tau <= t, (g + 1) * (tau / t) ** g / t, 0)

    rows, columns = ((10.0, 3.0), (30.0, 17.0)), ((20.0, 7.0), (30.0, 3.0))
    found = products(*np.array(rows).T, *np.array(columns).T)
    expected = [[(profile(*row) * profile(*column)).sum() * 30 / 600_000 for column in columns] for row in rows]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_a_snapshots_own_average_is_found_again():
    weights = combination([10, 20, 30] * 2, [0.05] * 3 + [0.1] * 3, 30, 0.1)
    np.testing.assert_allclose(weights, [0, 0, 0, 0, 0, 1], atol=1e-6)


def test_averages_of_other_lengths_are_built_from_snapshots(tmp_path):
    walk(tmp_path, 64)
    folder = tmp_path / "snapshots"
    assert len(list(folder.iterdir())) == 2 * 16
    for length in (0.05, 0.07, 0.1, 0.15):
        built = float(average_of(folder, length)["weight"])
        assert built == pytest.approx(profile_mean(64, length), rel=0.01), length
    assert float(average_of(folder, 0.1, step=32)["weight"]) == pytest.approx(profile_mean(32, 0.1), rel=0.01)


def test_a_resumed_run_goes_on_with_its_averages(tmp_path):
    (tmp_path / "whole").mkdir(), (tmp_path / "parts").mkdir()
    walk(tmp_path / "whole", 8)
    walk(tmp_path / "parts", 5).save_checkpoint(tmp_path / "last.ckpt")
    walk(tmp_path / "parts", 8, ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    whole, parts = (float(average_of(tmp_path / run / "snapshots", 0.1, 8)["weight"]) for run in ("whole", "parts"))
    assert parts == pytest.approx(whole, rel=2e-3)


def test_what_cannot_be_averaged_is_said(tmp_path):
    with pytest.raises(CheckpointError, match="has no snapshots"):
        average_of(tmp_path, 0.1)
    with pytest.raises(ConfigError, match=r"length 0\.5 must be above 0"):
        exponent_of(0.5)
