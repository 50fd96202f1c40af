"""Results to a page, pictures and tables."""

import logging
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from nerfdiff.chart.marks import KINDS, OTHER, Mark, marks_of
from nerfdiff.chart.page import write_page
from nerfdiff.chart.payload import (
    Measured,
    charted,
    configuration_values,
    failure_values,
    failures,
    measured,
    share_words,
)
from nerfdiff.chart.pictures import SmallSheets
from nerfdiff.chart.png import write_png
from nerfdiff.chart.published import published_for, read_published
from nerfdiff.chart.spending import is_adaptive, spending_values, spent_by
from nerfdiff.chart.stability import stability_values
from nerfdiff.cli import command_words
from nerfdiff.metrics.table import METRICS, reward_note
from nerfdiff.results.frame import (
    RESULTS,
    Run,
    configuration_columns,
    configuration_line,
    configurations,
    find_results,
    read_runs,
    run_lines,
)
from nerfdiff.results.row import COLUMNS, RowFile
from nerfdiff.results.text import one_line, write_csv
from nerfdiff.stability.study import studies
from nerfdiff.stress.axes import stress_files
from nerfdiff.utils.errors import ConfigError, DataError

log = logging.getLogger(__name__)

HOW = (
    "A point is a configuration: runs that agree in everything but their seed. Its name has what tells it from the "
    "others, a click shows all of its settings. Bars are {level:.0%} bootstrap intervals of the difference to "
    "{reference} with the same model, scene by scene, over scenes; the seeds of a scene are averaged first. Better or "
    "worse is what its interval says; whatever reaches over zero is level. Fréchet distances are one number of a run, "
    "and fewer than {fewest} scenes are too few: they have no interval. Seconds are the mean over seeds of the medians "
    "over scenes. The frontier is that of means; faint points are dominated: another is at least as good and as cheap, "
    "and better in one. Hollow: some runs failed."
)
"""The page's words on its numbers."""


@dataclass
class Found:
    """Runs of all files of results, and what is not shown of what else was there."""

    runs: list[Run] = field(default_factory=list)
    files: int = 0
    unread: list[str] = field(default_factory=list)

    def warn(self, text: str) -> None:
        log.warning("%s", one_line(text))
        self.unread.append(text)


def build_chart(cfg: DictConfig) -> Path:
    """Write `index.html`, `configurations.csv`, `runs.csv` and a PNG per metric and cost into `cfg.out`.

    Small contact sheets are within the page; whole ones, videos and folders are links relative to it, so that it shows
    them where it lies beside its results. Results without rows, or with failures alone, make a page that says so.

    Returns:
        the page's path.

    Raises:
        DataError: there is no such file or folder, or a file of results has no row that can be read (of files found
            within a folder the page says so instead, as long as others can be read; as it does of single lines).
        ConfigError: the file of published values cannot be read, or they are inconsistent; or plotly or itables is not
            installed, which only the page needs: tables and pictures are written before it.
    """
    places = _places(cfg.results)
    found = _read(places)
    if astray := sum(run.astray for run in found.runs):
        found.warn(
            f"{astray} of {len(found.runs)} runs say that their folders lie outside of these results: "
            "nothing is shown from there (results= takes several folders)"
        )
    out = Path(cfg.out) if cfg.out is not None else _folder(places[0]) / "chart"
    metrics, costs = charted(), _plain(cfg.costs)
    bootstrap = instantiate(cfg.bootstrap)
    plain_runs = [run for run in found.runs if run.row.stress is None]  # stressed ones are no choice of speed
    own = configurations(plain_runs, bootstrap, found.warn)
    content = measured(own, metrics, costs, cfg.unnamed, _plain(cfg.picks), bootstrap)
    papers = read_published(cfg.published)
    published = [published_for(panel, **papers) for panel in content.panels]
    failed = failures(plain_runs)
    rules, breaking = (instantiate(cfg.verdicts[name]) for name in ("rules", "bootstrap"))
    stability = stability_values(studies(found.runs, stress_files(), rules, breaking), out, cfg.pictures.strip_views)

    page = out / "index.html"
    sizes = cfg.pictures
    small = SmallSheets(sizes.width, sizes.height, sizes.megabytes, sizes.megapixels, found.warn)
    values = _values(out, content, published, failed, small)
    _add_spending(values["configurations"], content, cfg.picks.fidelity, cfg.spending_scenes, found.warn)
    write_csv(out / "configurations.csv", configuration_columns(), map(configuration_line, content.found))
    write_csv(out / "runs.csv", list(dict.fromkeys(("results", *COLUMNS, *METRICS))), run_lines(found.runs))
    pictures = _pngs(cfg, out, content, published)
    counts = f"{len(found.runs)} runs, {len(content.found)} configurations, {len(failures(found.runs))} failed runs"
    write_page(
        page,
        cfg.title,
        values
        | {
            "metrics": metrics,
            "costs": costs,
            "counts": f"{counts}; {datetime.now(UTC):%d %B %Y}",
            "how": HOW.format(level=bootstrap.level, reference=cfg.picks.reference, fewest=cfg.picks.fewest_scenes),
            "kinds": KINDS,
            "other": OTHER,
            "marks": {name: [mark.colour, mark.shape] for name, mark in _marks(content).items()},
            "webgl_above": cfg.webgl_above,
            "unread": found.unread,
            "stability": stability,
            "rewards": reward_note(metric.heading for metric in METRICS.values() if metric.within is not None),
            "empty": None if stability else _nothing(places, found, len(content.found)),
        },
    )
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
    roots = tuple(map(_folder, places))
    for place in places:
        for path in find_results(place, lambda error: found.warn(f"left out: {error.filename}: {error.strerror}")):
            if (real := Path(os.path.realpath(path))) in seen:
                continue
            seen.add(real)
            file = RowFile(path)
            try:
                runs = read_runs(file, roots)
                if file.skipped.lines and not runs:
                    raise DataError(str(file.skipped))
                found.runs += runs
                found.files += 1
                if file.skipped.lines:  # the reader has warned of them
                    found.unread.append(str(file.skipped))
            except DataError as error:
                if path == place:
                    raise
                found.warn(f"left out: {error}")
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
    out: Path,
    content: Measured,
    published: Sequence[list[dict[str, Any]]],
    failed: Sequence[Run],
    small: SmallSheets,
) -> dict[str, Any]:
    shown = [configuration_values(content, number, out) for number in range(len(content.found))]
    for entry, sheet in zip(shown, small.of(each.runs[0] for each in content.found), strict=True):
        entry["small"] = sheet
    lost = [failure_values(run) for run in failed]
    panels = [
        {"device": p.device, "cpu": p.cpu, "test": p.data, "members": p.members}
        | {"published": entries, "frontiers": every, "frontiers_3d": solid}
        | {"reference": content.reference(p), "answers": answers}
        for p, entries, every, solid, answers in zip(
            content.panels, published, content.frontiers, content.frontiers_3d, content.answers, strict=True
        )
    ]
    return {
        "words": share_words([*shown, *lost]),
        "configurations": shown,
        "failures": lost,
        "panels": panels,
    }


def _marks(content: Measured) -> dict[str, Mark]:
    return marks_of(configuration.row.strategy or "?" for configuration in content.found)


def _add_spending(
    entries: Sequence[dict[str, Any]], content: Measured, fidelity: str, points: int, warn: Callable[[str], object]
) -> None:
    """Return what each scene took beside its difficulty, for the first configurations: `points` scenes at most."""
    for number, entry in enumerate(entries):
        reference = content.references[number]
        difficulty = {} if reference is None else content.found[reference].scenes.get(fidelity, {})
        spent = [spent_by(run, warn) for run in content.found[number].runs] if points > 0 else []
        points -= sum(map(len, spent))
        entry["adaptive"] = is_adaptive(content.found[number], spent)
        entry["spending"] = spending_values(spent, difficulty)


def _pngs(cfg: DictConfig, out: Path, content: Measured, published: Sequence[list[dict[str, Any]]]) -> list[Path]:
    costs = {cost["field"]: cost for cost in _plain(cfg.costs)}
    if unknown := set(cfg.png.costs) - costs.keys():
        raise ConfigError(f"png.costs: {', '.join(sorted(unknown))} is not among the fields of costs")
    written = []
    for number, (panel, papers) in enumerate(zip(content.panels, published, strict=True), 1):
        entries = papers if cfg.png.published else ()
        for metric in charted():
            for cost in cfg.png.costs:
                if content.points(panel, metric["field"], cost, only_3d=True):
                    path = out / f"{metric['field']}-{cost}{f'-{number}' * (number > 1)}.png"
                    png = (path, content, panel, metric, costs[cost], entries, cfg.png.size, cfg.png.dpi, cfg.png.lines)
                    written.append(write_png(*png))
    return written
