"""Result rows as a table for people: on the terminal (rich) and in Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from nerfdiff.metrics.table import METRICS, reward_note
from nerfdiff.results.row import ResultRow, flatten
from nerfdiff.results.text import markdown_lines, one_line
from nerfdiff.utils.files import write_text


@dataclass(frozen=True)
class Column:
    """A column: which flattened field it shows, under which heading, in which format, in which unit."""

    field: str
    heading: str
    format: str = ""
    scale: float = 1


COSTS = (
    Column("fid_n", "images"),
    Column("encode_s_median", "encode, s", ".3g"),
    Column("render_s_median", "render, s/view", ".3g"),
    Column("distill_s_median", "distil, s", ".3g"),
    Column("scene_s_median", "scene, s", ".3g"),
    Column("peak_mem_bytes", "memory, GiB", ".2f", 2**-30),
    Column("params", "parameters, M", ".1f", 1e-6),
    Column("dataset", "dataset"),
    Column("weights", "weights"),
    Column("seed", "seed"),
    Column("n_scenes", "scenes"),
    Column("fallbacks", "fell back"),
    Column("device", "device"),
)


def all_columns() -> list[Column]:
    """The strategy, all metrics, what they cost and where."""
    metrics = [Column(metric.name, metric.heading, metric.format) for metric in METRICS.values()]
    return [Column("strategy", "strategy"), *metrics, *COSTS]


def cells(rows: Sequence[ResultRow]) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the columns that some row has a value for.

    A status column appears if any run failed; what a row lacks is "–".
    """
    flat = [flatten(row) for row in rows]
    failed = any(row.status != "ok" for row in rows)
    columns = [c for c in all_columns() if any(row.get(c.field) is not None for row in flat)]
    if failed:
        columns.append(Column("status", "status"))
    return [c.heading for c in columns], [[_cell(row.get(c.field), c) for c in columns] for row in flat]


def _cell(value: Any, column: Column) -> str:
    if value is None:
        return "–"
    return format(value * column.scale, column.format) if column.format else one_line(str(value))


def rich_table(rows: Sequence[ResultRow], width: int, title: str | None = None) -> Table:
    """A table to print with rich, no wider than `width` characters.

    Below it stands what is the same in every row, and the headings of columns that did not fit.
    """
    headings, body = cells(rows)
    columns = list(zip(headings, zip(*body, strict=True), strict=True))
    told = {"dataset", "weights", "seed", "scenes", "images", "device"} if len(rows) > 1 else set()
    same = [(heading, values[0]) for heading, values in columns if heading in told and len(set(values)) == 1]
    columns = [column for column in columns if column[0] not in dict(same)]
    shown, left = [], width - 1
    for heading, values in columns:
        needed = max(map(len, (*([heading] if len(heading) <= 9 else heading.split()), *values)))
        left -= needed + 3
        if left >= 0 or not shown:
            shown.append((heading, values, needed))
    notes = [", ".join(f"{heading} {value}" for heading, value in same)]
    notes.append(reward_note(heading for heading, *_ in shown))
    if len(shown) < len(columns):
        notes.append("too narrow for: " + ", ".join(heading for heading, _ in columns[len(shown) :]))
    caption = Text("\n".join(filter(None, notes)))  # names may have brackets, which are no markup
    table = Table(title=title and Text(one_line(title)), caption=caption if caption else None, caption_justify="left")
    numeric = {c.heading for c in all_columns() if c.format} | {"scenes", "seed", "images"}
    for heading, _, needed in shown:
        table.add_column(heading, justify="right" if heading in numeric else "left", width=needed)
    for line in zip(*(values for _, values, _ in shown), strict=True):
        table.add_row(*map(Text, line))
    return table


def markdown(rows: Sequence[ResultRow]) -> str:
    """A Markdown table, ending in a newline."""
    headings, body = cells(rows)
    note = reward_note(headings)
    return markdown_lines([headings, *body]) + (f"\n{note}\n" if note else "")


def write_markdown(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write `markdown(rows)` atomically."""
    write_text(Path(path), markdown(rows))
