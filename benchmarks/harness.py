"""How benchmarks measure and what they leave: interleaved timings, the device's own limits, a table and a file.

Variants of one piece of work are timed in turn, round after round, so that whatever slows the machine slows them all;
the first variant is the reference, and ratios are medians over rounds. The device's copy bandwidth and matrix rate are
measured in the same run.
"""

import argparse
import json
import math
import os
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table

from nerfdiff.results.environment import environment
from nerfdiff.results.files import atomic, write_text
from nerfdiff.results.timing import Stopwatch, summarise

RESULTS = Path(os.environ.get("OUT") or Path(__file__).parent / "results")
"""Where files go that no --out sends elsewhere: into $OUT, where it is set."""
SHORTEST = 5e-3
"""Seconds: quicker calls are timed several at once, so that starting and waiting for the device do not count."""


@dataclass(frozen=True)
class Work:
    """What has to be done, however it is done.

    Args:
        flops: floating-point operations, a multiplication and an addition being two.
        bytes: to be moved between memory and processor.
    """

    flops: float
    bytes: float


@dataclass(frozen=True)
class Unavailable:
    """Why a variant cannot run here."""

    reason: str


Variant = Callable[[], Any] | Unavailable


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
    """What the device does at best, measured.

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
    made.add_argument("--model", choices=("tiny", "small", "base", "large"), default=model, help="with random weights")
    made.add_argument("--ckpt", help="a trained model instead, as for evaluate.py: demo, a run's folder, a file")
    made.add_argument("--size", type=int, help="image side in pixels; default: the model's own")
    made.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1, …")
    made.add_argument("--precision", choices=("auto", "32-true", "bf16-mixed"), default="auto")
    made.add_argument("--seconds", type=float, default=5.0, help="for each variant at each setting, about")
    made.add_argument("--threads", type=int, help="CPU threads of PyTorch")
    made.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    made.add_argument("overrides", nargs="*", help="of the training config, as model.render.chunk=65536")
    if sweeps:
        made.add_argument("--sweep", choices=sweeps, help="a scaling curve")
        made.add_argument("--values", type=int, nargs="+", help="of the sweep, instead of its own")
    return made


def interleaved(variants: Mapping[str, Variant], device: torch.device, seconds: float) -> dict[str, Row]:
    """Time variants in turn, after a warm-up, for about `seconds` each; one that fails, but for the first, says why."""
    rows = {name: Row(name, {}) for name in variants}
    calls: dict[str, Callable[[], Any]] = {}
    repeats: dict[str, int] = {}
    for name, variant in variants.items():
        if isinstance(variant, Unavailable):
            rows[name].reason = variant.reason
            continue
        try:
            repeats[name] = _warm_up(variant, device, seconds)
            calls[name] = variant
        except RuntimeError as error:
            if not calls:
                raise
            rows[name].reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    times: dict[str, list[float]] = {name: [] for name in calls}
    spent = 0.0
    while calls and (spent < seconds * len(calls) or (len(next(iter(times.values()))) < 3 and spent < 3 * seconds)):
        for name, call in calls.items():
            elapsed = _timed(call, device, repeats[name])
            times[name].append(elapsed / repeats[name])
            spent += elapsed
    reference = times.get(next(iter(variants)))
    for name, own in times.items():
        rows[name].seconds = summarise(own)
        if reference is not None:
            rows[name].ratio = statistics.median(r / o for r, o in zip(reference, own, strict=True))
    return rows


def _warm_up(call: Callable[[], Any], device: torch.device, seconds: float) -> int:
    """Call until nothing new happens; how many calls make one measurement."""
    total, count, last = 0.0, 0, math.inf
    while count == 0 or (count < 3 and total < seconds / 3):
        last = _timed(call, device, 1)
        total, count = total + last, count + 1
    return max(1, math.ceil(SHORTEST / last))


def _timed(call: Callable[[], Any], device: torch.device, repeats: int) -> float:
    watch = Stopwatch(device)
    with watch.measure():
        for _ in range(repeats):
            call()
    return watch.seconds[0]


@lru_cache
def limits(device: torch.device, dtype: torch.dtype, seconds: float) -> Limits:
    """Measure the device, for about `seconds` twice."""
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


def report(
    benchmark: str,
    subject: Any,
    rows: Sequence[Row],
    limit: Limits,
    settings: Mapping[str, Any],
    out: Path,
    notes: Sequence[str] = (),
    sweep: str | None = None,
) -> Path:
    """Print the table, write it as JSON (and a sweep as a picture), and return the JSON's path.

    Args:
        subject: a `subjects.Subject`.
        settings: what the rows have in common.
        notes: what a reader must know to read the numbers.
    """
    facts = environment(subject.device, subject.precision)
    hardware = facts["device"] if subject.device.type == "cuda" else facts["cpu"]
    now = datetime.now(UTC)
    name = benchmark if sweep is None else f"{benchmark}-{sweep}"
    path = out / f"{name}-{slug(subject.name)}-{slug(hardware)}-{now:%Y-%m-%d}.json"
    content = {
        "benchmark": benchmark,
        "sweep": sweep,
        "time": now.isoformat(timespec="seconds"),
        "model": subject.name,
        "parameters": subject.model.parameter_count(),
        "image_size": [subject.size, subject.size],
        "settings": dict(settings),
        "hardware": hardware,
        "environment": facts | {"threads": torch.get_num_threads(), "cores": os.cpu_count()},
        "limits": asdict(limit),
        "notes": list(notes),
        "rows": [asdict(row) | _rates(row, limit) for row in rows],
    }
    write_text(path, json.dumps(content, indent=1) + "\n")
    title = f"{name}: {subject.name}, {subject.size} pixels, {subject.precision}, on {hardware}"
    _print(title, rows, limit, settings, notes)
    if sweep is not None:
        _plot(path.with_suffix(".png"), title, sweep, rows)
    print(path)
    return path


def slug(text: str) -> str:
    """For a file name: lower case, and one dash for all that is neither letter nor digit."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _rates(row: Row, limit: Limits) -> dict[str, float | None]:
    """Shares of what the device does at best."""
    if row.seconds is None or row.work is None:
        return {"share_of_matrix_rate": None, "share_of_copy_bandwidth": None}
    seconds = row.seconds["median"]
    return {
        "share_of_matrix_rate": row.work.flops / seconds / limit.matrix,
        "share_of_copy_bandwidth": row.work.bytes / seconds / limit.copy,
    }


def _print(title: str, rows: Sequence[Row], limit: Limits, settings: Mapping[str, Any], notes: Sequence[str]) -> None:
    keys = dict.fromkeys(key for row in rows for key in row.setting)
    varying = [key for key in keys if len({row.setting.get(key) for row in rows}) > 1]
    more = list(dict.fromkeys(key for row in rows for key in row.more))
    table = Table(box=box.SIMPLE, pad_edge=False)
    for column in ("", *varying, "median", "IQR", "× ref.", "GFLOP", "of matrix", "MB", "of copy", *more):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        if row.seconds is None:
            continue
        rates = _rates(row, limit)
        cells = [row.name, *(str(row.setting.get(key, "")) for key in varying)]
        cells += [duration(row.seconds["median"]), duration(row.seconds["iqr"])]
        cells.append("" if row.ratio is None else f"{row.ratio:.2f}")
        cells += ["", "", "", ""] if row.work is None else [
            f"{row.work.flops / 1e9:,.2f}",
            f"{100 * rates['share_of_matrix_rate']:.1f} %",
            f"{row.work.bytes / 1e6:,.1f}",
            f"{100 * rates['share_of_copy_bandwidth']:.1f} %",
        ]  # fmt: skip
        cells += [number(row.more[key]) if key in row.more else "" for key in more]
        table.add_row(*cells)
    console = Console()
    if not console.is_terminal:
        console = Console(width=200)  # a log has room for every column
    console.print(f"\n{title}", style="bold", highlight=False)
    console.print(", ".join(f"{key} {value}" for key, value in settings.items()), highlight=False)
    console.print(table)
    rates = f"{limit.copy / 1e9:,.1f} GB/s, {limit.dtype} matrices {limit.matrix / 1e12:,.3f} TFLOP/s"
    reasons = dict.fromkeys(f"{row.name}: not run, {row.reason}" for row in rows if row.reason is not None)
    for line in (f"the device at best, measured: copy {rates}", *notes, *reasons):
        console.print(line, highlight=False, markup=False)


def duration(seconds: float) -> str:
    """With the unit that suits it."""
    unit, scale = ("s", 1.0) if seconds >= 1 else ("ms", 1e-3) if seconds >= 1e-3 else ("µs", 1e-6)
    return f"{seconds / scale:,.3g} {unit}" if seconds < 1000 else f"{seconds:,.0f} s"


def number(value: Any) -> str:
    """As short as it can be read."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def _plot(path: Path, title: str, sweep: str, rows: Sequence[Row]) -> None:
    """Seconds over the swept value, one line per variant; dashed is what proportional cost would be."""
    from matplotlib.figure import Figure  # not pyplot: no global state, and no display

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(row.name for row in rows):
        points = [(row.setting[sweep], row.seconds) for row in rows if row.name == name and row.seconds]
        if points:
            values, seconds = zip(*points, strict=True)
            (line,) = axes.plot(values, [s["median"] for s in seconds], "o-", label=name)
            proportional = [seconds[0]["median"] * value / values[0] for value in values]
            axes.plot(values, proportional, "--", color=line.get_color(), alpha=0.3)
    axes.set(title=title, xlabel=sweep, ylabel="seconds", xscale="log", yscale="log")
    axes.legend(frameon=False)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=100)
