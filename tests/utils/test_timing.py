import pytest
import torch

from nerfdiff.utils import timing
from nerfdiff.utils.timing import PartClock, Stopwatch, cost_of_a_piece, summarise, timed


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


def test_stopwatch_measures_what_is_inside_only(clock):
    stopwatch = Stopwatch()
    for seconds in (1.0, 2.0):
        with stopwatch.measure():
            clock(seconds)
        clock(50.0)
    assert stopwatch.seconds == [1.0, 2.0]


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
    assert stopwatch.seconds == []


def test_parts_are_known_by_name_while_a_clock_runs(clock):
    parts = PartClock()

    @timed("walk")
    def walk(seconds):
        clock(seconds)

    walk(7.0)  # nobody measures
    with parts.running():
        walk(1.0)
        clock(50.0)
        with timed("rest"):
            clock(2.0)
        walk(3.0)
        with pytest.raises(KeyError), timed("walk"):
            raise KeyError
    walk(7.0)
    assert parts.seconds() == {"walk": [1.0, 3.0], "rest": [2.0]}


def test_the_outer_clock_is_back_when_an_inner_one_ends(clock):
    outer, inner = PartClock(), PartClock()
    with outer.running():
        with inner.running(), timed("a"):
            clock(1.0)
        with timed("b"):
            clock(2.0)
    assert (outer.seconds(), inner.seconds()) == ({"b": [2.0]}, {"a": [1.0]})


def test_parts_on_a_gpu_are_marked_in_its_stream_and_read_at_the_end(monkeypatch):
    """The host waits for the device once, when asked for the sums; the clock of the host is not looked at."""
    told = []

    class Event:
        def __init__(self, enable_timing):
            assert enable_timing

        def record(self, stream):
            told.append(f"record in {stream}")
            self.when = len(told)

        def elapsed_time(self, end):
            return 1000.0 * (end.when - self.when)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: f"stream of {device}")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: told.append("wait"))
    monkeypatch.setattr(timing.time, "perf_counter", None)
    parts = PartClock("cuda:1")
    with parts.running():
        for _ in range(2):
            with timed("fit"):
                told.append("work")
    assert told == ["record in stream of cuda:1", "work", "record in stream of cuda:1"] * 2
    assert parts.seconds() == {"fit": [2.0, 2.0]} and told[6:] == ["wait"]


def test_what_a_piece_costs_is_measured(monkeypatch):
    """A clock that goes on by a microsecond whenever it is read: twice for a piece, and around them all."""
    reads = iter(range(10_000))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(reads) * 1e-6)
    assert cost_of_a_piece(n=100) == pytest.approx(2e-6, rel=0.02)
