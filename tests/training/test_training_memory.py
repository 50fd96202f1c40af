"""What the tracer counts, on tensors whose sizes are known, and what is done with it."""

import gc

import pytest
import torch

from model_fixtures import config
from nerfdiff.model import build_on_meta
from nerfdiff.training import memory
from nerfdiff.training.memory import HEADROOM, PeakMemory, TrainingMemory, is_tight, training_memory, within_memory
from nerfdiff.utils.errors import ConfigError


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_the_peak_of_known_tensors(device):
    with PeakMemory() as tracker:
        a = torch.empty(1000, device=device)
        b = a * 2  # 8000 bytes
        view = b.view(10, 100)
        del a, b  # the view keeps its storage
        assert tracker.live == 4000
        c = view + 1
        c += 1  # in place: no new memory
        assert (tracker.live, tracker.peak) == (8000, 8000)
        del view, c
    assert (tracker.live, tracker.peak) == (0, 8000)


def test_activations_kept_for_the_backward_pass_count():
    layers = torch.nn.Sequential(*(torch.nn.Sequential(torch.nn.Linear(10, 10), torch.nn.Sigmoid()) for _ in range(5)))
    with PeakMemory() as tracker:
        layers(torch.empty(100, 10)).sum().backward()
    # sigmoids keep their 100 x 10 outputs, which are the inputs of the next layer
    assert 5 * 4000 <= tracker.peak <= 9 * 4000


def test_a_step_holds_the_gradients_and_grows_with_the_batch_but_little_with_checkpointing():
    parameters = sum(p.numel() for p in build_on_meta(config()).parameters())
    one, four = (training_memory(config(), batch, 1, 16, 16, "32-true") for batch in (1, 4))
    assert one.state == 16 * parameters and one.step > 4 * parameters
    assert four.state == one.state and four.step > one.step
    frugal = training_memory(config(unet={"checkpointing": True}, render={"chunk": 512}), 4, 1, 16, 16, "32-true")
    assert frugal.step < four.step
    mixed = training_memory(config(), 4, 1, 16, 16, "bf16-mixed")
    assert mixed.state == four.state and mixed.step < four.step


def test_recomputing_at_more_resolutions_keeps_less():
    sizes = [
        training_memory(config(unet={"checkpointing": choice}), 8, 1, 16, 16, "32-true").step
        for choice in (False, [1], [2], True)
    ]
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == 4


@pytest.mark.parametrize("choice", [False, True])
def test_a_trace_does_not_depend_on_when_garbage_is_collected(choice):
    often, thresholds = (3, 1, 1), gc.get_threshold()
    sizes = set()
    for setting in (thresholds, often):
        gc.set_threshold(*setting)
        try:
            sizes.add(training_memory(config(unet={"checkpointing": choice}), 8, 1, 16, 16, "32-true").step)
        finally:
            gc.set_threshold(*thresholds)
    assert len(sizes) == 1 and gc.isenabled()


@pytest.mark.parametrize("batch", [1, 5])
def test_the_largest_batch_is_the_last_that_fits(batch, monkeypatch):
    monkeypatch.setattr(memory, "training_memory", lambda *a: TrainingMemory(1000, 10 * a[1] + a[1] // 4))
    for spare, expected in ((0, batch), (9, batch), (-1, batch - 1)):
        available = memory.training_memory({}, batch).total + spare
        assert memory.largest_batch({}, available, 1, 16, 16, "32-true") == expected


def test_the_largest_batch_of_a_traced_model_fits_and_one_more_does_not():
    available = training_memory(config(), 3, 1, 16, 16, "32-true").total
    assert memory.largest_batch(config(), available, 1, 16, 16, "32-true") == 3


def test_what_does_not_fit_is_refused_with_what_it_takes(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda device: 10**6)
    with pytest.raises(ConfigError, match=r"training takes about .* cpu has 0\.0 GiB free.*accumulate_grad_batches"):
        within_memory(config(), torch.device("cpu"), 1, 1, 16, 16, "32-true")
    assert is_tight(config(), torch.device("cpu"))
    monkeypatch.setattr(memory, "free_memory", lambda device: 10**15)
    assert within_memory(config(), torch.device("cpu"), 1, 1, 16, 16, "32-true") == config()
    assert not is_tight(config(), torch.device("cpu"))


@pytest.mark.parametrize("choice", [False, [1], True])
def test_no_more_is_recomputed_than_memory_asks_for(choice, monkeypatch):
    step = 8, 1, 16, 16, "32-true"
    needed = training_memory(config(unet={"checkpointing": choice}), *step).total
    monkeypatch.setattr(memory, "free_memory", lambda device: int(needed / HEADROOM) + 1)
    settled = within_memory(config(unet={"checkpointing": "auto"}), torch.device("cpu"), *step)
    assert settled == config(unet={"checkpointing": choice})


def test_where_recomputing_everything_is_not_enough_the_run_is_refused(monkeypatch):
    step = 8, 1, 16, 16, "32-true"
    needed = training_memory(config(unet={"checkpointing": True}), *step).total
    monkeypatch.setattr(memory, "free_memory", lambda device: needed - 1)
    with pytest.raises(ConfigError, match="training takes about"):
        within_memory(config(unet={"checkpointing": "auto"}), torch.device("cpu"), *step)
    monkeypatch.setattr(memory, "free_memory", lambda device: needed)
    assert within_memory(config(unet={"checkpointing": "auto"}), torch.device("cpu"), *step)["unet"]["checkpointing"]
