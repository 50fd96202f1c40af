import time

import pytest
import torch

from nerfdiff.results import timing
from nerfdiff.results.timing import Stopwatch, summarise, time_calls


def test_summary_is_count_median_and_interquartile_range():
    assert summarise([5.0, 1.0, 3.0, 2.0, 4.0]) == {"n": 5, "median": 3.0, "iqr": 2.0}
    assert summarise([0.5]) == {"n": 1, "median": 0.5, "iqr": 0.0}
    assert summarise([]) is None


def test_warm_up_is_not_counted():
    calls = []

    def first_call_is_slow():
        calls.append(None)
        if len(calls) == 1:
            time.sleep(0.2)

    timed = time_calls(first_call_is_slow, n=4, warmup=1)
    assert len(calls) == 5 and timed["n"] == 4 and timed["median"] < 0.1


def test_stopwatch_measures_what_is_inside_only():
    stopwatch = Stopwatch(warmup=1)
    for _ in range(3):
        with stopwatch.measure():
            time.sleep(0.01)
        time.sleep(0.05)
    assert stopwatch.summary()["n"] == 2
    assert 0.01 <= stopwatch.summary()["median"] < 0.05
    assert Stopwatch(warmup=1).summary() is None


def test_cuda_work_is_waited_for_on_both_sides(monkeypatch):
    events = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: events.append(str(device)))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: events.append("clock") or 0.0)
    with Stopwatch("cuda:1").measure():
        events.append("work")
    assert events == ["cuda:1", "clock", "work", "cuda:1", "clock"]


def test_a_failed_piece_is_not_counted():
    stopwatch = Stopwatch()
    with pytest.raises(RuntimeError), stopwatch.measure():
        raise RuntimeError
    assert stopwatch.summary() is None
