"""Reports of benchmarks: a table on the terminal, a file that names model, hardware and date, a sweep's picture.

`python benchmarks/report.py FOLDER…` prints what is in such files."""

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table

from harness import NO_TIME, Limits, Row
from nerfdiff.results.environment import environment
from nerfdiff.utils.files import atomic, write_text


class Report:
    """A table that grows: whatever stops a benchmark, the groups of variants measured by then are in its file.

    Until all is measured, that is a file ….partial.json, which says `"complete": false`.

    Args:
        subject: a `subjects.Subject`.
        settings: what the rows have in common.
        notes: what a reader must know to read the numbers.
    """

    def __init__(
        self,
        benchmark: str,
        subject: Any,
        limit: Limits,
        settings: Mapping[str, Any],
        out: Path,
        notes: Sequence[str] = (),
        sweep: str | None = None,
    ):
        self.subject, self.limit, self.sweep = subject, limit, sweep
        self.rows: list[Row] = []
        self.settings, self.notes = dict(settings), list(notes)
        facts = environment(subject.device, subject.precision)
        hardware = facts["device"] if subject.device.type == "cuda" else facts["cpu"]
        now = datetime.now(UTC)
        self.name = benchmark if sweep is None else f"{benchmark}-{sweep}"
        self.title = f"{self.name}: {subject.name}, {subject.size} pixels, {subject.precision}, on {hardware}"
        self.path = out / f"{self.name}-{slug(subject.name)}-{slug(hardware)}-{now:%Y-%m-%d}.json"
        self._partial = self.path.with_suffix(".partial.json")
        self._facts = {
            "benchmark": benchmark,
            "sweep": sweep,
            "time": now.isoformat(timespec="seconds"),
            "model": subject.name,
            "parameters": subject.model.parameter_count(),
            "image_size": [subject.size, subject.size],
            "hardware": hardware,
            "environment": facts | {"threads": torch.get_num_threads(), "cores": os.cpu_count()},
            "limits": asdict(limit),
        }

    def add(self, rows: Sequence[Row]) -> None:
        """Write what was measured up to here."""
        self.rows += rows
        self._write(self._partial, complete=False)
        print(f"{len(self.rows)} rows so far: {self._partial}", flush=True)

    def finish(self) -> Path:
        """Print the table, write it as JSON (and a sweep as a picture), and return the JSON's path."""
        complete = all(row.reason != NO_TIME for row in self.rows)
        path = self.path if complete else self._partial
        self._write(path, complete)
        if complete:
            self._partial.unlink(missing_ok=True)
        _print(self.title, self.rows, self.limit, self.settings, self.notes)
        if self.sweep is not None:
            _plot(path.with_suffix(".png"), self.title, self.sweep, self.rows)
        print(path)
        return path

    def _write(self, path: Path, complete: bool) -> None:
        rows = [asdict(row) | _rates(row, self.limit) for row in self.rows]
        measured = {"settings": self.settings, "notes": self.notes, "complete": complete, "rows": rows}
        write_text(path, json.dumps(self._facts | measured, indent=1) + "\n")


def table(folders: Sequence[Path]) -> str:
    """One line for each row that is in the files of these folders, with what was not measured and why."""
    lines = []
    for path in (path for folder in folders for path in sorted(folder.glob("*.json"))):
        content = json.loads(path.read_text())
        lines += ["", " ".join((content["benchmark"], content["model"], "on", content["hardware"], content["time"]))]
        lines += ["  " + ", ".join(f"{key} {value}" for key, value in content["settings"].items()), *content["notes"]]
        lines += [] if content["complete"] else ["INCOMPLETE: stopped before all was measured"]
        for row in content["rows"]:
            if row["seconds"] is None:
                lines.append(f"  {row['name']}: {row['reason']}")
                continue
            share = row["share_of_matrix_rate"]
            rates = [] if share is None else [f"{100 * share:.1f} % of the matrix rate"]
            rates += [] if row["ratio"] is None else [f"{row['ratio']:.2f} x reference"]
            rates += [f"{key} {number(value)}" for key, value in row["more"].items()]
            lines.append(f"  {row['name']}: {', '.join([duration(row['seconds']['median']), *rates])}")
    return "\n".join(lines)


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
    """Format a number as shortly as it can be read."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def _plot(path: Path, title: str, sweep: str, rows: Sequence[Row]) -> None:
    """Seconds over the swept value, one line per variant; dashed is what proportional cost would be."""
    from matplotlib.figure import Figure  # not pyplot: no global state, and no display

    names = dict.fromkeys(row.name for row in rows)
    figure = Figure(figsize=(6, max(4, 0.25 * len(names))), layout="constrained")  # a line of the legend for each
    axes = figure.subplots()
    for name in names:
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


if __name__ == "__main__":
    print(table([Path(folder) for folder in sys.argv[1:]]))
