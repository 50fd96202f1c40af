"""Make a data set of procedural scenes: plan, share the work among processes, report."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nerfdiff.errors import ConfigError
from nerfdiff.scenes.contact_sheet import write_contact_sheet
from nerfdiff.scenes.layout import SPLITS, check_manifest, exclusive, split_folder
from nerfdiff.scenes.mitsuba_renderer import resolve_variant
from nerfdiff.scenes.pool import process_count, render_all
from nerfdiff.scenes.poses import SPIRAL_VIEWS
from nerfdiff.scenes.scene_job import BUILDERS, STYLES, SceneJob

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
    console, started = Console(), time.perf_counter()
    variant, category, root = resolve_variant(cfg["variant"]), cfg["scenes"]["category"], Path(cfg["root"])
    jobs = list(_plan(cfg, root))
    with exclusive(root):
        check_manifest(root, _parameters(cfg, variant))
        waiting = [job for job in jobs if not job.folder.is_dir()]
        processes = max(1, min(process_count(cfg["processes"], variant), len(waiting)))
        console.print(
            f"{category}: {len(waiting)} of {len(jobs)} scenes to render into {root.resolve()} "
            f"({variant}, {processes} process{'es' if processes > 1 else ''})"
        )
        renderer = (variant, cfg["resolution"], cfg["samples_per_pixel"])
        rendered = _render(waiting, processes, renderer, console) if waiting else 0
        sheet = None
        if cfg["contact_sheet"]["enabled"]:
            size = (cfg["contact_sheet"]["scenes"], cfg["contact_sheet"]["views"])
            sheet = write_contact_sheet(root, [job.folder for job in jobs], *size)
    seconds, kept = time.perf_counter() - started, len(jobs) - len(waiting)
    for split, wanted in cfg["splits"].items():
        if wanted["scenes"]:
            console.print(f"  {split}: {root.resolve() / split_folder(category, split)}", soft_wrap=True)
    if sheet is not None:
        console.print(f"  contact sheet: {sheet.resolve()}", soft_wrap=True)
    console.print(f"  {rendered} images in {seconds:.0f} s; {kept} scenes were there already")
    sheet = None if sheet is None else str(sheet)
    return {"root": str(root), "rendered": rendered, "kept": kept, "seconds": seconds, "contact_sheet": sheet}


def _check(cfg: dict[str, Any]) -> None:
    """Refuse impossible values with the valid ones."""
    category = cfg["scenes"]["category"]
    if category not in BUILDERS:
        raise ConfigError(f"scenes.category={category}: expected one of {', '.join(BUILDERS)}")
    styles = cfg["scenes"]["styles"]
    unknown = sorted(set(styles) - set(STYLES[category]))
    if unknown:
        raise ConfigError(
            f"scenes.styles: unknown {', '.join(unknown)}; {category} come as {', '.join(STYLES[category])}"
        )
    if any(weight < 0 for weight in styles.values()) or not sum(styles.values()) > 0:
        raise ConfigError(f"scenes.styles={styles}: expected weights of at least 0, one of them above 0")
    if not cfg["splits"] or set(cfg["splits"]) - set(SPLITS):
        raise ConfigError(f"splits={sorted(cfg['splits'])}: expected some of {', '.join(SPLITS)}")
    for split, wanted in cfg["splits"].items():
        if not isinstance(wanted, dict) or wanted["scenes"] < 0 or wanted["views"] < 1:
            raise ConfigError(f"splits.{split}={wanted}: expected scenes >= 0 and views >= 1")
        if split != "train" and wanted["views"] > SPIRAL_VIEWS:
            raise ConfigError(f"splits.{split}.views={wanted['views']}: the spiral has {SPIRAL_VIEWS} views")
    counts = {key: cfg[key] for key in ("resolution", "samples_per_pixel")}
    counts |= {f"contact_sheet.{key}": cfg["contact_sheet"][key] for key in ("scenes", "views")}
    if cfg["processes"] != "auto":
        counts["processes"] = cfg["processes"]
    for key, value in counts.items():
        if not isinstance(value, int) or value < 1:
            raise ConfigError(f"{key}={value}: expected a whole number of at least 1")
    if not cfg["scenes"]["radius"] > 0.5:
        raise ConfigError(f"scenes.radius={cfg['scenes']['radius']}: expected more than 0.5, outside the object")
    low, high = cfg["scenes"]["elevation"]
    if not -90 <= low < high <= 90:
        raise ConfigError(f"scenes.elevation=[{low}, {high}]: expected two ascending degrees from -90 to 90")
    if not isinstance(cfg["seed"], int) or cfg["seed"] < 0:
        raise ConfigError(f"seed={cfg['seed']}: expected an integer of at least 0")


def _parameters(cfg: dict[str, Any], variant: str) -> dict[str, Any]:
    """All that the files of a scene depend on."""
    return {
        "generator_version": GENERATOR_VERSION,
        "category": cfg["scenes"]["category"],
        "radius": cfg["scenes"]["radius"],
        "elevation": cfg["scenes"]["elevation"],
        "styles": cfg["scenes"]["styles"],
        "seed": cfg["seed"],
        "resolution": cfg["resolution"],
        "samples_per_pixel": cfg["samples_per_pixel"],
        "variant": variant,
        "views": {split: wanted["views"] for split, wanted in cfg["splits"].items()},
    }


def _plan(cfg: dict[str, Any], root: Path) -> Iterator[SceneJob]:
    scenes = cfg["scenes"]
    for split, wanted in cfg["splits"].items():
        for index in range(wanted["scenes"]):
            yield SceneJob(
                root,
                scenes["category"],
                split,
                index,
                wanted["views"],
                cfg["seed"],
                scenes["radius"],
                tuple(scenes["elevation"]),
                scenes["styles"],
            )


def _render(jobs: list[SceneJob], processes: int, renderer: tuple[str, int, int], console: Console) -> int:
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
        for count in render_all(jobs, processes, renderer):
            done += count
            rate = done / (time.perf_counter() - started)
            progress.update(bar, completed=done, rate=f"{rate:.1f} images/s")
    return done
