"""Timings that can be compared: repeated, after a warm-up, and waiting for the GPU to finish."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
        warmup: pieces at the start that are not counted.
    """

    def __init__(self, device: torch.device | str = "cpu", warmup: int = 0):
        self.device, self.warmup = torch.device(device), warmup
        self.all_seconds: list[float] = []

    @property
    def seconds(self) -> list[float]:
        """Durations after the warm-up."""
        return self.all_seconds[self.warmup :]

    @contextmanager
    def measure(self) -> Iterator[None]:
        self._synchronise()
        start = time.perf_counter()
        yield
        self._synchronise()
        self.all_seconds.append(time.perf_counter() - start)

    def summary(self) -> dict[str, float | int] | None:
        """{n, median, iqr} in seconds; None if nothing came after the warm-up."""
        return summarise(self.seconds)

    def _synchronise(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def time_calls(
    call: Callable[[], Any], n: int, warmup: int, device: torch.device | str = "cpu"
) -> dict[str, float | int] | None:
    """{n, median, iqr} in seconds of `n` calls after `warmup` uncounted ones."""
    stopwatch = Stopwatch(device, warmup)
    for _ in range(warmup + n):
        with stopwatch.measure():
            call()
    return stopwatch.summary()
