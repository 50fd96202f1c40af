import math

import numpy as np
import pytest

from nerfdiff.training.callbacks.stability import Stability


def test_the_99th_percentile_is_known_to_a_percent_without_keeping_the_norms():
    norms = np.random.default_rng(0).lognormal(mean=-1.0, sigma=2.0, size=20_000)
    record = Stability(spike=3.0, memory=10)
    for norm in norms:
        record.add(float(norm), 1.0)
    exact = np.quantile(norms, 0.99, method="inverted_cdf")
    assert record.summary()["grad_norm_p99"] == pytest.approx(exact, rel=0.011)
    assert len(record.state_dict()["norms"]) < 1000


def test_a_jump_of_the_loss_is_a_spike_and_a_new_level_is_not_one_for_ever():
    record = Stability(spike=3.0, memory=10)
    for step in range(60):
        record.add(1.0, 31.0 if step == 2 else 1.0)  # before the mean is known nothing can be told
    assert record.spikes == 0
    for loss in (2.9, 1.0, 4.5, 1.0, 50.0, 1.0):
        record.add(1.0, loss)
    assert record.spikes == 2
    for _ in range(200):
        record.add(1.0, 10.0)
    assert 2 < record.spikes < 20
    assert record.summary()["nonfinite_grad_steps"] == 0


def test_steps_that_are_not_finite_are_counted_and_leave_the_rest_alone():
    record = Stability(spike=2.0, memory=2)
    for norm, loss in ((2.0, 1.0), (math.nan, math.nan), (math.inf, 1.0), (2.0, math.inf), (2.0, 1.0)):
        record.add(norm, loss)
    assert record.summary() == {
        "nonfinite_grad_steps": 2,
        "loss_spikes": 0,
        "grad_norm_p99": pytest.approx(2.0, rel=0.011),
    }
    assert Stability(2.0, 2).summary()["grad_norm_p99"] is None


def test_a_record_goes_on_where_it_was():
    whole, first = Stability(3.0, 5), Stability(3.0, 5)
    steps = [(0.1 * (1 + i % 7), 5.0 if i % 11 == 10 else 1.0 + 0.1 * (i % 3)) for i in range(40)]
    for i, step in enumerate(steps):
        whole.add(*step)
        if i < 20:
            first.add(*step)
    second = Stability(3.0, 5)
    second.load_state_dict(first.state_dict())
    for step in steps[20:]:
        second.add(*step)
    assert second.state_dict() == whole.state_dict() and whole.spikes == 3
