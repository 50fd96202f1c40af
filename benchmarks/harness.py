"""Measuring for benchmarks: interleaved timings, and the device's own limits.

Variants of one piece of work are timed in turn, round after round, so that whatever slows the machine slows them all;
the first variant is the reference, and ratios are medians over rounds. The device's copy bandwidth and matrix rate are
measured in the same run.
"""

import argparse
import math
import os
import signal
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from nerfdiff.cli import choices
from nerfdiff.utils.timing import Stopwatch, summarise

RESULTS = Path(os.environ.get("OUT") or Path(__file__).parent / "results")
"""Folder of the files without --out: $OUT where it is set."""
SHORTEST = 5e-3
"""Seconds: quicker calls are timed several at once, so that starting and waiting for the device do not count."""
NO_TIME = "no time left"
"""Reason given for a variant that was not measured before the deadline."""


class Deadline:
    """From when on nothing new is measured: what is there by then is to be reported."""

    def __init__(self):
        self.end = math.inf

    def set(self, end: str) -> float:
        """Set the end in Unix time, so that a process's start counts."""
        self.end = float(end)
        return self.end

    @property
    def passed(self) -> bool:
        return time.time() > self.end


DEADLINE = Deadline()
"""Deadline of this process, set by --until."""


@dataclass(frozen=True)
class Work:
    """Work that has to be done, however it is done.

    Args:
        flops: floating-point operations, a multiplication and an addition being two.
        bytes: to be moved between memory and processor.
    """

    flops: float
    bytes: float


@dataclass(frozen=True)
class Unavailable:
    """A variant that cannot run here, and the reason."""

    reason: str


Variant = Callable[[], Any] | Unavailable


class Overrun(BaseException):
    """A variant took more than its share of the time. Not for what falls back where kernels fail to catch."""


@dataclass
class Row:
    """One variant at one setting.

    Args:
        name: of the variant.
        setting: what was measured, e.g. {"rays": 4096}.
        seconds: {n, median, iqr} of one call; None where it did not run.
        ratio: how many times faster than the reference.
        work: of one call.
        more: further numbers, by name.
        reason: why it did not run.
    """

    name: str
    setting: dict[str, Any]
    seconds: dict[str, float | int] | None = None
    ratio: float | None = None
    work: Work | None = None
    more: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None


@dataclass(frozen=True)
class Limits:
    """The device's best rates, measured.

    Args:
        copy: bytes per second of a large copy, read and written.
        matrix: FLOP per second of a product of large square matrices of type `dtype`.
    """

    copy: float
    matrix: float
    dtype: str


def parser(description: str, model: str = "tiny", sweeps: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The options that benchmarks share."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--model", choices=choices("model"), default=model, help="with random weights")
    made.add_argument("--ckpt", help="a trained model instead, as for evaluate.py: demo, a run's folder, a file")
    made.add_argument("--size", type=int, help="image side in pixels; default: the model's own")
    made.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1, …")
    made.add_argument("--precision", choices=("auto", "32-true", "bf16-mixed"), default="auto")
    made.add_argument("--seconds", type=float, default=5.0, help="for each variant at each setting, about")
    made.add_argument("--until", type=DEADLINE.set, metavar="UNIX_TIME", help="then report what is there")
    made.add_argument("--threads", type=int, help="CPU threads of PyTorch")
    made.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    made.add_argument("overrides", nargs="*", help="of the training config, as model.render.chunk=65536")
    if sweeps:
        made.add_argument("--sweep", choices=sweeps, help="a scaling curve")
        made.add_argument("--values", type=int, nargs="+", help="of the sweep, instead of its own")
    return made


def settings_of(
    arguments: argparse.Namespace, usual: Mapping[str, int], sweeps: Mapping[str, Sequence[int]]
) -> list[dict[str, int]]:
    """Return the settings to measure: the usual one, or a scaling curve's, in which one value differs."""
    if arguments.sweep is None:
        return [dict(usual)]
    return [dict(usual) | {arguments.sweep: value} for value in arguments.values or sweeps[arguments.sweep]]


def interleaved(variants: Mapping[str, Variant], device: torch.device, seconds: float) -> dict[str, Row]:
    """Time variants in turn, after a warm-up, for about `seconds` each; one that fails, but for the first, says why.

    Before a deadline each has an equal share of the time that is left for its warm-up: one that takes longer is dropped
    and says so, as does one whose turn comes after. One call of which takes longer than `seconds` is measured by its
    last warm-up call, so that the others have their rounds.
    """
    rows = {name: Row(name, {}) for name in variants}
    calls: dict[str, Callable[[], Any]] = {}
    repeats: dict[str, int] = {}
    slow: dict[str, float] = {}
    for number, (name, variant) in enumerate(variants.items()):
        if isinstance(variant, Unavailable):
            rows[name].reason = variant.reason
            continue
        if DEADLINE.passed:
            rows[name].reason = NO_TIME
            continue
        try:
            with _within((DEADLINE.end - time.time()) / (len(variants) - number)):
                last = _warm_up(variant, device, seconds)
            print(f"  {name}: {last:.3g} s a call at first", flush=True)
            if last > seconds and len(variants) > 1:
                slow[name] = last
            else:
                repeats[name], calls[name] = max(1, math.ceil(SHORTEST / last)), variant
        except Overrun as error:
            rows[name].reason = str(error)
        except RuntimeError as error:
            if not calls and not slow:
                raise
            rows[name].reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    times: dict[str, list[float]] = {name: [] for name in calls}
    spent = 0.0
    rounds = 0
    while calls and (spent < seconds * len(calls) or (rounds < 3 and spent < 3 * seconds)):
        if rounds and DEADLINE.passed:
            break
        rounds += 1
        for name, call in calls.items():
            elapsed = _timed(call, device, repeats[name])
            times[name].append(elapsed / repeats[name])
            spent += elapsed
    times |= {name: [last] for name, last in slow.items()}
    reference = times.get(next(iter(variants)))
    for name, own in times.items():
        rows[name].seconds = summarise(own)
        if reference is not None and len(reference) == len(own):
            rows[name].ratio = statistics.median(r / o for r, o in zip(reference, own, strict=True))
        elif reference is not None:
            rows[name].ratio = statistics.median(reference) / statistics.median(own)
    return rows


@contextmanager
def _within(seconds: float) -> Iterator[None]:
    """Raises Overrun in what takes longer."""

    def stop(*_):
        raise Overrun(f"dropped after {seconds:.3g} s, its share of the time")

    if math.isinf(seconds):
        yield
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _warm_up(call: Callable[[], Any], device: torch.device, seconds: float) -> float:
    """Call until nothing new happens; seconds of the last call."""
    total, count, last = 0.0, 0, math.inf
    while count == 0 or (count < 3 and total < seconds / 3):
        last = _timed(call, device, 1)
        total, count = total + last, count + 1
    return last


def _timed(call: Callable[[], Any], device: torch.device, repeats: int) -> float:
    watch = Stopwatch(device)
    with watch.measure():
        for _ in range(repeats):
            call()
    return watch.seconds[0]


@lru_cache
def limits(device: torch.device, dtype: torch.dtype, seconds: float) -> Limits:
    """Measure the device, for about `seconds` twice.

    Raises:
        SystemExit: there is no time left, and so nothing to report.
    """
    if DEADLINE.passed:
        raise SystemExit(f"{NO_TIME} for any measurement")
    large = device.type == "cuda"
    source = torch.ones(2**28 if large else 2**24, device=device)
    target = torch.empty_like(source)
    side = 8192 if large else 1024
    # of noise: a GPU multiplies zeros faster than it can keep up with numbers
    left, right = torch.randn(2, side, side, device=device).to(dtype)
    product = torch.empty_like(left)
    copied = interleaved({"copy": lambda: target.copy_(source)}, device, seconds)["copy"]
    multiplied = interleaved({"matrix": lambda: torch.mm(left, right, out=product)}, device, seconds)["matrix"]
    return Limits(
        copy=2 * source.nbytes / copied.seconds["median"],
        matrix=2 * side**3 / multiplied.seconds["median"],
        dtype=str(dtype).removeprefix("torch."),
    )
