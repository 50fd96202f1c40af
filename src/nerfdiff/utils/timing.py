"""Timings that can be compared, since none ends before the GPU does, and that cost the computation next to nothing."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch


def summarise(seconds: Sequence[float]) -> dict[str, float | int] | None:
    """{n, median, iqr} of some durations; None if there are none."""
    if len(seconds) == 0:
        return None
    low, median, high = np.percentile(np.asarray(seconds, dtype=np.float64), [25, 50, 75])
    return {"n": len(seconds), "median": float(median), "iqr": float(high - low)}


class Stopwatch:
    """Collects durations of pieces of a longer computation.

    Args:
        device: its pending work is waited for before and after each piece.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self.seconds: list[float] = []

    @contextmanager
    def measure(self) -> Iterator[None]:
        self._synchronise()
        start = time.perf_counter()
        yield
        self._synchronise()
        self.seconds.append(time.perf_counter() - start)

    def _synchronise(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


class PartClock:
    """Seconds spent in the parts of a longer computation, which `timed` marks; nothing waits for the device meanwhile.

    On a GPU a pair of events in the stream marks a piece, and is read when `seconds` asks; elsewhere the host's clock.

    Args:
        device: that does the work.
    """

    _running: ContextVar["PartClock | None"] = ContextVar("running", default=None)

    def __init__(self, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self._pieces: list[tuple[str, Any, Any]] = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """Time the pieces that `timed` marks in here."""
        token = PartClock._running.set(self)
        try:
            yield
        finally:
            PartClock._running.reset(token)

    def seconds(self) -> dict[str, list[float]]:
        """Return the seconds of each part's pieces. Waits for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        parts: dict[str, list[float]] = {}
        for name, start, end in self._pieces:
            took = start.elapsed_time(end) / 1000 if self.device.type == "cuda" else end - start
            parts.setdefault(name, []).append(took)
        return parts

    def _now(self) -> Any:
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event


@contextmanager
def timed(name: str) -> Iterator[None]:
    """One piece of a part, for the running `PartClock` if there is one; as a context or on a function.

    Pieces are counted when they end well, and are not to lie within each other: each would count the inner one too.
    """
    clock = PartClock._running.get()
    start = clock and clock._now()
    yield
    if clock is not None:
        clock._pieces.append((name, start, clock._now()))


def cost_of_a_piece(device: torch.device | str = "cpu", n: int = 1000) -> float:
    """Seconds of the host that timing one piece takes, measured on `n` empty ones."""
    start = time.perf_counter()
    with PartClock(device).running():
        for _ in range(n):
            with timed("nothing"):
                pass
    return (time.perf_counter() - start) / n
