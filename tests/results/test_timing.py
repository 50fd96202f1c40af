import pytest
import torch

from nerfdiff.results import timing
from nerfdiff.results.timing import Stopwatch, summarise, time_calls


def test_summary_is_count_median_and_interquartile_range():
    assert summarise([5.0, 1.0, 3.0, 2.0, 4.0]) == {"n": 5, "median": 3.0, "iqr": 2.0}
    assert summarise([0.5]) == {"n": 1, "median": 0.5, "iqr": 0.0}
    assert summarise([]) is None


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only when told to: `clock(seconds)`."""
    now = [100.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def pass_time(seconds):
        now[0] += seconds

    return pass_time


def test_warm_up_is_not_counted(clock):
    durations = iter([8.0, 1.0, 2.0, 3.0])
    timed = time_calls(lambda: clock(next(durations)), n=3, warmup=1)
    assert timed == {"n": 3, "median": 2.0, "iqr": 1.0}
    assert next(durations, None) is None


def test_stopwatch_measures_what_is_inside_only(clock):
    stopwatch = Stopwatch(warmup=1)
    for _ in range(3):
        with stopwatch.measure():
            clock(1.0)
        clock(50.0)
    assert stopwatch.seconds == [1.0, 1.0]
    assert stopwatch.summary() == {"n": 2, "median": 1.0, "iqr": 0.0}
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
