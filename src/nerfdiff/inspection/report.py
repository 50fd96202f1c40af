"""The report: tables on the terminal, the same in Markdown, and everything in JSON."""

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from nerfdiff.inspection.check import Status
from nerfdiff.inspection.summary import SplitSummary
from nerfdiff.results.text import markdown_cell, one_line
from nerfdiff.utils.files import write_text

COLOURS = {Status.OK: "green", Status.FAILED: "bold red", Status.UNCHECKED: "yellow"}
FACTS = ("split", "scenes", "views per scene", "read", "height x width", "focal length, px", "field of view, °",
         "near", "far", "mask / depth")  # fmt: skip


def facts(summary: SplitSummary) -> list[str]:
    """One cell per heading of `FACTS`; what is not known is "–"."""
    sizes = ", ".join(size if len(summary.sizes) == 1 else f"{size} ({n})" for size, n in summary.sizes.items())
    truth = " / ".join(_some_of(count, summary.scenes_read) for count in (summary.masks, summary.depths))
    values = (summary.views, None, None, summary.focal, summary.fov, summary.near, summary.far)
    views, _, _, focal, fov, near, far = ("–" if value is None else str(value) for value in values)
    read = f"{summary.scenes_read} scenes, {summary.images_read} images"
    return [summary.stage, str(summary.scenes), views, read, sizes or "–", focal, fov, near, far, truth]


def _some_of(count: int, total: int) -> str:
    return "no" if count == 0 else "yes" if count == total else f"{count} of {total}"


def _told(text: str) -> str:
    """For the terminal: names of data are no markup."""
    return escape(one_line(text))


def print_report(console: Console, title: str, splits: Sequence[SplitSummary], limit: int) -> None:
    """Tables of facts and of checks, then bad and suspect scenes (at most `limit` of each split)."""
    there = [split for split in splits if not split.absent and not split.error]
    table = Table(title=_told(title))
    for heading in FACTS:
        table.add_column(heading)
    for split in there:
        table.add_row(*map(_told, facts(split)))
    checks = Table()
    for heading in ("split", "check", "result", "found"):
        checks.add_column(heading)
    for split in there:
        for found in split.checks:
            colour = COLOURS[found.status]
            checks.add_row(split.stage, found.check, f"[{colour}]{found.status}[/]", _told(found.text))
        checks.add_section()
    if there:
        console.print(table, checks)
    for split in splits:
        if split.absent or split.error:
            colour = "yellow" if split.absent else "bold red"
            state = "not there" if split.absent else "cannot be read"
            console.print(f"[{colour}]{split.stage}: {state}[/]: {_told(split.absent or split.error)}", soft_wrap=True)
        for scene, reason in list(split.bad.items())[:limit]:
            console.print(f"[bold red]bad scene[/] {split.stage} {_told(f'{scene}: {reason}')}", soft_wrap=True)
        if len(split.bad) > limit:
            console.print(f"  and {len(split.bad) - limit} more bad scenes, all in the report")
        for line in _suspects(split)[:limit]:
            console.print(f"[yellow]suspect[/] {split.stage} {_told(line)}", soft_wrap=True)
        for line in _notes(split):
            console.print(f"[bold]{split.stage}[/]: {_told(line)}", soft_wrap=True)


def write_report(folder: Path, title: str, splits: Sequence[SplitSummary]) -> list[Path]:
    """Save `report.md` and `report.json`; returns their paths."""
    failed = any(split.failures for split in splits)
    content = {"dataset": title, "status": "failed" if failed else "ok", "splits": [s.as_dict() for s in splits]}
    paths = [folder / "report.md", folder / "report.json"]
    write_text(paths[0], markdown(title, splits))
    write_text(paths[1], json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    return paths


def markdown(title: str, splits: Sequence[SplitSummary]) -> str:
    """The whole report, with the pictures by name."""
    there = [split for split in splits if not split.absent and not split.error]
    parts = [f"# {markdown_cell(title)}\n"]
    if there:
        parts.append(_table(FACTS, [list(map(markdown_cell, facts(split))) for split in there]))
    for split in splits:
        parts.append(f"## {split.stage}\n")
        if split.absent or split.error:
            state = "Not there" if split.absent else "Cannot be read"
            parts.append(f"{state}: {markdown_cell(split.absent or split.error)}\n")
            continue
        rows = [[found.check, f"**{found.status}**", markdown_cell(found.text)] for found in split.checks]
        parts.append(_table(("check", "result", "found"), rows))
        parts += [f"{line}\n" for line in _notes(split)]
        bad = [f"- {markdown_cell(f'{scene}: {reason}')}" for scene, reason in split.bad.items()]
        suspects = [f"- {markdown_cell(line)}" for line in _suspects(split)]
        for heading, lines in (("Bad scenes", bad), ("Suspect scenes", suspects)):
            if lines:
                parts.append(f"### {heading}\n\n" + "\n".join(lines) + "\n")
        parts += [f"![{split.stage}, {what}]({name})\n" for what, name in split.pictures.items()]
    return "\n".join(parts)


def _notes(split: SplitSummary) -> list[str]:
    notes = []
    if split.scenes_read and not split.compared:
        notes = [
            "cameras unchecked: there is no depth, silhouette or texture to tell by whether they fit the images; look "
            "at the pictures" + ("" if split.allow_unchecked else ", then let them pass with allow_unchecked=true")
        ]
    elif split.compared < split.scenes_read:
        notes = [f"cameras unchecked in {split.scenes_read - split.compared} of {split.scenes_read} scenes"]
    if split.compared and not split.focal_told:
        notes.append("focal length unchecked: silhouettes hardly change with it; compare it with the data's source")
    if split.explanations is None or not any(found.status is Status.FAILED for found in split.checks):
        return notes  # a few suspects are no reason to doubt all cameras
    if not split.explanations:
        notes.append(
            "no common misreading of cameras (axes, inverse, transposed, other resolution) explains the failure"
        )
    return notes + [f"every check of the cameras would pass if {name}" for name in split.explanations]


def _suspects(split: SplitSummary) -> list[str]:
    return [f"{scene} ({found.check}): {why}" for found in split.checks for scene, why in found.suspects.items()]


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _plain(value):
    """For JSON, which has no infinity."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value
