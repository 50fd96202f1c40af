"""A sweep's lines as text: CSV with every number, Markdown, and a table for the terminal."""

import io
from collections.abc import Sequence
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from nerfdiff.metrics.table import METRICS, reward_note
from nerfdiff.results.intervals import Estimate
from nerfdiff.results.table import Column, all_columns
from nerfdiff.results.text import csv_lines, markdown_cell, markdown_lines, one_line
from nerfdiff.sweeps.jobs import shown
from nerfdiff.sweeps.lines import Line

NOTE = (
    "Mean over seeds and scenes [bootstrap interval over scenes]; Δ to the reference, scene by scene. "
    "Fréchet distances and seconds: mean over seeds [range]. What was not measured is –."
)


def to_csv(lines: Sequence[Line]) -> str:
    """Every number, one line per row of the table."""
    flat = []
    for line in lines:
        row: dict[str, Any] = dict(line.labels)
        row |= {"status": line.status, "seeds": line.seeds, "scenes": line.scenes, "fallbacks": line.fallbacks}
        for name, estimate in line.metrics.items():
            row |= _parts(name, estimate)
        for name, estimate in line.differences.items():
            row |= _parts(f"{name}_difference", estimate)
        row |= {f"{name}_gap_closed": value for name, value in line.closed.items()}
        row |= {f"paper_{name}": value for name, value in line.paper.items()}
        row |= {"frontier": " ".join(line.frontier)} if line.frontier else {}
        flat.append(row | {"error": line.error})
    columns = list(dict.fromkeys(column for row in flat for column in row if column != "error"))
    text = io.StringIO()
    csv_lines(text, [*columns, "error"], flat)
    return text.getvalue()


def to_markdown(lines: Sequence[Line], notes: Sequence[str] = ()) -> str:
    """A row per line, what its numbers are, and `notes`."""
    headings, body = cells(lines)
    told = [f"{markdown_cell(note)}\n" for note in filter(None, [reward_note(headings), *notes])]
    return "\n".join([markdown_lines([headings, *body]), f"{NOTE}\n", *told])


def to_rich(lines: Sequence[Line], notes: Sequence[str] = ()) -> Group:
    """The same on its side, a terminal having more room for rows than for columns; what went wrong stands below."""
    headings, body = cells(lines)
    table = Table(show_header=False)
    for column in range(len(body) + 1):
        table.add_column(justify="right" if column else "left", overflow="fold")
    for heading, *values in zip(headings, *body, strict=True):
        if heading != "error":
            table.add_row(*(Text(one_line(cell)) for cell in (heading, *values)))  # brackets are no markup here
    errors = [f"{line.name}: {line.error}" for line in lines if line.error]
    return Group(
        table, *(Text(one_line(text)) for text in filter(None, [*errors, NOTE, reward_note(headings), *notes]))
    )


def cells(lines: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the columns that some line has a value for; the paper's numbers stand beside ours."""
    columns: list[tuple[str, list[str]]] = []

    def add(heading: str, values: Sequence[str | None]) -> None:
        if any(value is not None for value in values):
            columns.append((heading, ["–" if value is None else value for value in values]))

    for key in dict.fromkeys(key for line in lines for key in line.labels):
        heading = key.rpartition(".")[2]
        add(heading, [shown(line.labels[key]) if key in line.labels else None for line in lines])
    for column in all_columns():
        name = column.field.removesuffix("_median")
        add(column.heading, [_estimate(line.metrics.get(name), column) for line in lines])
        if name in METRICS and METRICS[name].compared:  # the CSV has all
            add(f"Δ {column.heading}", [_estimate(line.differences.get(name), column, "+") for line in lines])
        add(f"paper: {column.heading}", [_number(line.paper.get(name), column) for line in lines])
        add(f"{column.heading.removesuffix(' ↓')} gap closed", [_share(line.closed.get(name)) for line in lines])
    add("on the frontier of", [_names(line.frontier) for line in lines])
    add("fell back", [str(line.fallbacks) if line.fallbacks else None for line in lines])
    add("seeds", [str(line.seeds) for line in lines])
    add("scenes", [str(line.scenes) for line in lines])
    add("status", [line.status for line in lines])
    add("error", [line.error for line in lines])
    return [heading for heading, _ in columns], [
        list(row) for row in zip(*(values for _, values in columns), strict=True)
    ]


def _parts(name: str, estimate: Estimate) -> dict[str, float | None]:
    return {name: estimate.mean, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def _estimate(estimate: Estimate | None, column: Column, sign: str = "") -> str | None:
    if estimate is None:
        return None
    mean, *ends = (_number(value, column, sign) for value in estimate)
    return mean if ends[0] is None else f"{mean} [{ends[0]}, {ends[1]}]"


def _number(value: float | None, column: Column, sign: str = "") -> str | None:
    return None if value is None else format(value * column.scale, sign + column.format)


def _names(fields: Sequence[str]) -> str | None:
    return ", ".join(column.heading.rstrip(" ↑↓†") for column in all_columns() if column.field in fields) or None


def _share(value: float | None) -> str | None:
    return None if value is None else f"{value:.0%}"
