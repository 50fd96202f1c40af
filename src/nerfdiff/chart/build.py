"""Results to a page, pictures and tables."""

import logging
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from nerfdiff.chart.page import write_page
from nerfdiff.chart.payload import Measured, configuration_values, failure_values, failures, measured, share_words
from nerfdiff.chart.pictures import small_sheets
from nerfdiff.chart.png import write_png
from nerfdiff.chart.published import published_for
from nerfdiff.cli import command_words
from nerfdiff.errors import ConfigError, DataError
from nerfdiff.results.files import write_text
from nerfdiff.results.frame import (
    RESULTS,
    Run,
    configurations,
    configurations_frame,
    find_results,
    read_runs,
    runs_frame,
)

log = logging.getLogger(__name__)

HOW = (
    "A point is a configuration: runs that agree in everything but their seed. Its name has what tells it from the "
    "others, a click shows all of its settings. Intervals of qualities measured per scene are {level:.0%} bootstrap "
    "intervals over scenes and seeds; of Fréchet distances, counts and sizes the range over seeds. Seconds are the "
    "mean over seeds of the medians; their intervals span the median ± half the interquartile range of every seed. "
    "Faint points are dominated: another is at least as good and as cheap, and better in one. Rings: some runs failed."
)
"""What the page says of its numbers."""


@dataclass
class Found:
    """Runs of all files of results, and what was wrong with the others."""

    runs: list[Run] = field(default_factory=list)
    files: int = 0
    unread: list[str] = field(default_factory=list)


def build_chart(cfg: DictConfig) -> Path:
    """Write `index.html`, `configurations.csv`, `runs.csv` and a PNG per metric and cost into `cfg.out`.

    Small contact sheets are within the page; whole ones, videos and folders are links relative to it, so that it shows
    them where it lies beside its results. Results without rows, or with failures alone, make a page that says so.

    Returns:
        the page's path.

    Raises:
        DataError: there is no such file or folder; a file of results or scores is damaged or of another schema (files
            found within a folder are named on the page instead, as long as others can be read).
        ConfigError: published values are inconsistent.
    """
    places = _places(cfg.results)
    found = _read(places)
    out = Path(cfg.out) if cfg.out is not None else _folder(places[0]) / "chart"
    metrics, costs = _plain(cfg.metrics), _plain(cfg.costs)
    bootstrap = instantiate(cfg.bootstrap)
    content = measured(configurations(found.runs, bootstrap), metrics, costs, cfg.unnamed)
    published = [published_for(panel, **_plain(cfg.published)) for panel in content.panels]
    failed = failures(found.runs)

    page, table = out / "index.html", configurations_frame(content.found)
    values = _values(cfg, out, content, published, failed)
    counts = f"{len(found.runs)} runs, {len(content.found)} configurations, {len(failed)} failed runs"
    write_page(
        page,
        cfg.title,
        values
        | {
            "metrics": metrics,
            "costs": costs,
            "counts": f"{counts}; {datetime.now(UTC):%d %B %Y}",
            "how": HOW.format(level=bootstrap.level),
            "webgl_above": cfg.webgl_above,
            "unread": found.unread,
            "empty": _nothing(places, found, len(content.found)),
        },
    )
    write_text(out / "configurations.csv", table.to_csv(index=False))
    write_text(out / "runs.csv", runs_frame(found.runs).to_csv(index=False))
    pictures = _pngs(cfg, out, content, published)
    log.info("page: %s   beside it: configurations.csv, runs.csv and %d PNGs", page, len(pictures))
    return page


def _plain(node: DictConfig | ListConfig) -> Any:
    return OmegaConf.to_container(node, resolve=True)


def _places(results: str | ListConfig) -> list[Path]:
    places = [Path(place) for place in ([results] if isinstance(results, str) else results)]
    if not places:
        raise ConfigError(f"results=[] names nothing; name folders of runs, or files called {RESULTS}")
    return places


def _folder(place: Path) -> Path:
    return place.parent if place.is_file() else place


def _read(places: Sequence[Path]) -> Found:
    found, first, seen = Found(), None, set()
    for place in places:
        for path in find_results(place):
            if (file := path.resolve()) in seen:
                continue
            seen.add(file)
            try:
                found.runs += read_runs(path)
                found.files += 1
            except DataError as error:
                if path == place:
                    raise
                log.warning("left out: %s", error)
                found.unread.append(f"left out: {error}")
                first = first or error
    if first is not None and not found.files:
        raise first
    return found


def _nothing(places: Sequence[Path], found: Found, configurations: int) -> str | None:
    """Words for a page without points."""
    if configurations:
        return None
    where = " and ".join(map(str, places))
    if found.runs:
        return f"All {len(found.runs)} runs in {where} failed; why is below."
    example = shlex.join([*command_words("distill"), "sweep=speed_accuracy", "ckpt=demo", "budget=minutes"])
    return (
        f"There are no results in {where} yet: evaluations, distillations and sweeps leave a {RESULTS}, as in {example}"
    )


def _values(
    cfg: DictConfig, out: Path, content: Measured, published: Sequence[list[dict[str, Any]]], failed: Sequence[Run]
) -> dict[str, Any]:
    shown = [configuration_values(content, number, out) for number in range(len(content.found))]
    small = small_sheets((each.runs[0] for each in content.found), cfg.pictures.width, cfg.pictures.megabytes)
    for entry, sheet in zip(shown, small, strict=True):
        entry["small"] = sheet
    lost = [failure_values(run) for run in failed]
    panels = [
        {"device": p.device, "cpu": p.cpu, "test": p.data, "members": p.members}
        | {"published": entries, "frontiers": frontiers}
        for p, entries, frontiers in zip(content.panels, published, content.frontiers, strict=True)
    ]
    return {
        "words": share_words([*shown, *lost]),
        "configurations": shown,
        "failures": lost,
        "panels": panels,
    }


def _pngs(cfg: DictConfig, out: Path, content: Measured, published: Sequence[list[dict[str, Any]]]) -> list[Path]:
    costs = {cost["field"]: cost for cost in _plain(cfg.costs)}
    if unknown := set(cfg.png.costs) - costs.keys():
        raise ConfigError(f"png.costs: {', '.join(sorted(unknown))} is not among the fields of costs")
    written = []
    for number, (panel, entries) in enumerate(zip(content.panels, published, strict=True), 1):
        for metric in _plain(cfg.metrics):
            for cost in cfg.png.costs:
                if content.points(panel, metric["field"], cost):
                    path = out / f"{metric['field']}-{cost}{f'-{number}' * (number > 1)}.png"
                    png = (path, content, panel, metric, costs[cost], entries, cfg.png.size, cfg.png.dpi)
                    written.append(write_png(*png))
    return written
