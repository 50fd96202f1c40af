"""Result rows as a table for people: on the terminal (rich) and in Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from nerfdiff.results.files import write_text
from nerfdiff.results.row import ResultRow, flatten


@dataclass(frozen=True)
class Column:
    """A column: which flattened field it shows, under which heading, in which format, in which unit."""

    field: str
    heading: str
    format: str = ""
    scale: float = 1


COLUMNS = (
    Column("dataset", "dataset"),
    Column("strategy", "strategy"),
    Column("weights", "weights"),
    Column("seed", "seed"),
    Column("n_scenes", "scenes"),
    Column("psnr", "PSNR ↑", ".2f"),
    Column("ssim", "SSIM ↑", ".3f"),
    Column("ssim_gaussian", "SSIM (Gaussian) ↑", ".3f"),
    Column("lpips", "LPIPS ↓", ".3f"),
    Column("fid", "FID ↓", ".2f"),
    Column("st_lpips_vgg", "ST-LPIPS ↓", ".3f"),
    Column("fd_st_vgg", "FD ST-VGG ↓", ".2f"),
    Column("fid_n", "images"),
    Column("depth_abs_rel", "depth abs rel ↓", ".3f"),
    Column("depth_rmse", "depth RMSE ↓", ".3f"),
    Column("mask_iou", "mask IoU ↑", ".3f"),
    Column("encode_s_median", "encode, s", ".3g"),
    Column("render_s_median", "render, s/view", ".3g"),
    Column("distill_s_median", "distil, s", ".3g"),
    Column("peak_mem_bytes", "memory, GiB", ".2f", 2**-30),
    Column("params", "parameters, M", ".1f", 1e-6),
    Column("device", "device"),
)


def cells(rows: Sequence[ResultRow]) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the columns that some row has a value for.

    A status column appears if any run failed; what a row lacks is "–".
    """
    flat = [flatten(row) for row in rows]
    failed = any(row.status != "ok" for row in rows)
    columns = [c for c in COLUMNS if any(row[c.field] is not None for row in flat)]
    if failed:
        columns.append(Column("status", "status"))
    return [c.heading for c in columns], [[_cell(row[c.field], c) for c in columns] for row in flat]


def _cell(value: Any, column: Column) -> str:
    if value is None:
        return "–"
    return format(value * column.scale, column.format) if column.format else str(value)


def rich_table(rows: Sequence[ResultRow], title: str | None = None) -> Table:
    """A table to print with rich."""
    headings, body = cells(rows)
    table = Table(title=title)
    numeric = {c.heading for c in COLUMNS if c.format} | {"scenes", "seed", "images"}
    for heading in headings:
        table.add_column(heading, justify="right" if heading in numeric else "left")
    for line in body:
        table.add_row(*line)
    return table


def markdown(rows: Sequence[ResultRow]) -> str:
    """A Markdown table, ending in a newline."""
    headings, body = cells(rows)
    lines = [headings, ["---"] * len(headings), *body]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def write_markdown(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write `markdown(rows)` atomically."""
    write_text(Path(path), markdown(rows))
