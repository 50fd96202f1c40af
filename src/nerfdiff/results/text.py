"""Text that came from outside (rows, overrides, names of data), made safe where it would be read as more than text."""

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from io import TextIOBase
from pathlib import Path
from typing import Any

from nerfdiff.utils.files import atomic

INVISIBLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]+")
"""Characters that move a cursor, colour a terminal, begin a line or turn the direction of writing."""
FORMULA = ("=", "+", "-", "@", "\t", "\r")


def one_line(text: str, longest: int | None = None) -> str:
    """Text without what steers a terminal; of `longest` characters at most, which end in … where it was cut."""
    if longest is not None and len(text) > longest:
        text = text[: longest - 1] + "…"
    return text if text.isascii() and text.isprintable() else INVISIBLE.sub(" ", text)


def markdown_cell(text: str) -> str:
    """Text as a cell of a Markdown table: without markup, links, pictures or HTML."""
    text = re.sub(r"([\\`*|])", r"\\\1", one_line(text)).replace("](", "]\\(")
    return text.replace("&", "&amp;").replace("<", "&lt;")


def markdown_lines(rows: Iterable[Sequence[str]]) -> str:
    """The lines of a Markdown table, the first being its headings."""
    headings, *body = ([markdown_cell(cell) for cell in row] for row in rows)
    return "".join("| " + " | ".join(line) + " |\n" for line in [headings, ["---"] * len(headings), *body])


def figure_text(text: str) -> str:
    """Text for matplotlib: no formula, no control characters, and not hidden in legends."""
    text = "\n".join(one_line(line) for line in text.split("\n")).replace("$", "\\$")
    return f" {text}" if text.startswith("_") else text


def csv_cell(value: Any) -> Any:
    """A value as a cell of a CSV: a text that a spreadsheet would compute begins with an apostrophe instead."""
    if not isinstance(value, str):
        return value
    value = value.encode(errors="replace").decode()
    return f"'{value}" if value.startswith(FORMULA) else value


def csv_lines(file: TextIOBase, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a table as CSV; what a row lacks, or has None for, is an empty cell."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(map(csv_cell, columns))
    writer.writerows([csv_cell(row.get(column)) for column in columns] for row in rows)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write `csv_lines` atomically, row by row."""
    with atomic(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv_lines(file, columns, rows)
