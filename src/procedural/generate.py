"""Make a data set of procedural scenes: plan, share the work among processes, report."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nerfdiff.utils.errors import ConfigError
from procedural.contact_sheet import write_contact_sheet
from procedural.kinds.choose import scene_kind
from procedural.kinds.kind import SceneJob, SceneKind
from procedural.mitsuba_renderer import resolve_variant
from procedural.pool import process_count, render_all
from procedural.root_folder import check_manifest, exclusive

# Raised whenever a change of the code changes the files of a given seed.
GENERATOR_VERSION = 2


def make_scenes(cfg: DictConfig | dict[str, Any]) -> dict[str, Any]:
    """Render the scenes that `conf/make_scenes.yaml` describes; those that are complete already are kept.

    Returns:
        `root`, `rendered` (images), `kept` (scenes), `seconds`, `contact_sheet` (its path, or None).

    Raises:
        ConfigError: a value is not possible, or `root` was made with other parameters.
        DataError: files cannot be written, or a worker process was killed.
    """
    cfg = OmegaConf.to_container(OmegaConf.create(cfg), resolve=True)
    _check(cfg)
    kind = scene_kind(cfg)
    console, started = Console(), time.perf_counter()
    variant, root = resolve_variant(cfg["variant"]), Path(cfg["root"])
    jobs = list(_plan(cfg, root))
    with exclusive(root):
        check_manifest(root, _parameters(cfg, kind, variant))
        waiting = [job for job in jobs if not kind.complete(job)]
        processes = max(1, min(process_count(cfg["processes"], variant), len(waiting)))
        console.print(
            f"{kind.category}: {len(waiting)} of {len(jobs)} scenes to render into {root.resolve()} "
            f"({variant}, {processes} process{'es' if processes > 1 else ''})",
            markup=False,
        )
        rendered = _render(kind, waiting, processes, variant, console) if waiting else 0
        kind.finish(root)
        sheet = None
        if cfg["contact_sheet"]["enabled"]:
            size = (cfg["contact_sheet"]["scenes"], cfg["contact_sheet"]["views"])
            sheet = write_contact_sheet(root, [kind.images(job) for job in jobs], *size)
    seconds, kept = time.perf_counter() - started, len(jobs) - len(waiting)
    for split, wanted in cfg["splits"].items():
        if wanted["scenes"]:
            console.print(f"  {split}: {(root / kind.split_folder(split)).resolve()}", soft_wrap=True, markup=False)
    if sheet is not None:
        console.print(f"  contact sheet: {sheet.resolve()}", soft_wrap=True, markup=False)
    console.print(f"  {rendered} images in {seconds:.0f} s; {kept} scenes were there already")
    sheet = None if sheet is None else str(sheet)
    return {"root": str(root), "rendered": rendered, "kept": kept, "seconds": seconds, "contact_sheet": sheet}


def _check(cfg: dict[str, Any]) -> None:
    """Refuse values that are impossible for every kind of scene."""
    for split, wanted in cfg["splits"].items():
        if not isinstance(wanted, dict) or wanted["scenes"] < 0 or wanted["views"] < 1:
            raise ConfigError(f"splits.{split}={wanted}: expected scenes >= 0 and views >= 1")
    counts = {key: cfg[key] for key in ("resolution", "samples_per_pixel")}
    counts |= {f"contact_sheet.{key}": cfg["contact_sheet"][key] for key in ("scenes", "views")}
    if cfg["processes"] != "auto":
        counts["processes"] = cfg["processes"]
    for key, value in counts.items():
        if not isinstance(value, int) or value < 1:
            raise ConfigError(f"{key}={value}: expected a whole number of at least 1")
    if not isinstance(cfg["seed"], int) or cfg["seed"] < 0:
        raise ConfigError(f"seed={cfg['seed']}: expected an integer of at least 0")


def _parameters(cfg: dict[str, Any], kind: SceneKind, variant: str) -> dict[str, Any]:
    """All that the files of a scene depend on."""
    return {
        "generator_version": GENERATOR_VERSION,
        "category": kind.category,
        **kind.parameters(),
        "seed": cfg["seed"],
        "resolution": cfg["resolution"],
        "samples_per_pixel": cfg["samples_per_pixel"],
        "variant": variant,
        "views": {split: wanted["views"] for split, wanted in cfg["splits"].items()},
    }


def _plan(cfg: dict[str, Any], root: Path) -> Iterator[SceneJob]:
    for split, wanted in cfg["splits"].items():
        for index in range(wanted["scenes"]):
            yield SceneJob(root, split, index, wanted["views"])


def _render(kind: SceneKind, jobs: list[SceneJob], processes: int, variant: str, console: Console) -> int:
    """Render `jobs`, in order as far as processes allow; returns the number of images."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    total, started = sum(job.views for job in jobs), time.perf_counter()
    done = 0
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("images", total=total, rate="")
        for count in render_all(kind, jobs, processes, variant):
            done += count
            rate = done / (time.perf_counter() - started)
            progress.update(bar, completed=done, rate=f"{rate:.1f} images/s")
    return done
