"""The stability view of the page: breaking points, curves over severity, and pictures of what breaks first."""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from PIL import Image

from nerfdiff.chart.pictures import WEBP_QUALITY, links
from nerfdiff.results.frame import Run
from nerfdiff.results.intervals import Estimate
from nerfdiff.stability.breaking import Breaking, Point
from nerfdiff.stability.study import Study, Verdict
from nerfdiff.stability.text import RULES, breaking_text, severity_text
from nerfdiff.utils.spread import spread


def stability_values(found: Sequence[Study], page: Path, views: int) -> list[dict[str, Any]]:
    """Studies as the page has them.

    Args:
        page: folder of the page, to which links are relative.
        views: of the first scene that breaks, in its picture.
    """
    return [_study(study, page, views) for study in found]


def _study(study: Study, page: Path, views: int) -> dict[str, Any]:
    by = {(verdict.axis, verdict.strategy): verdict for verdict in study.verdicts}
    strategies = list(dict.fromkeys(verdict.strategy for verdict in study.verdicts))
    axes = []
    for axis in dict.fromkeys(verdict.axis for verdict in study.verdicts):
        stress = study.axes[axis]
        own = {s: _cell(stress, by[axis, s], study, page, views) for s in strategies if (axis, s) in by}
        axes.append({"axis": axis, "name": stress.name, "source": stress.source, "cells": own})
    return {
        "settings": study.settings,
        "rules": RULES,
        "strategies": strategies,
        "silent": study.silent,
        "silent_lost": study.silent_lost,
        "broken": study.broken,
        "clean": {name: round(value, 2) for name, value in study.clean.items()},
        "axes": axes,
    }


def _cell(stress: DictConfig, verdict: Verdict, study: Study, page: Path, views: int) -> dict[str, Any]:
    return {
        "short": [_short(stress, breaking) for breaking in verdict.breaking],
        "full": [breaking_text(stress, breaking) for breaking in verdict.breaking],
        "share": min(breaking.share for breaking in verdict.breaking),
        "silent": verdict.silent,
        "area": verdict.area,
        "points": [_point(stress, point) for point in verdict.points],
        "pictures": _pictures(stress, verdict, study, page, views),
    }


def _short(stress: DictConfig, breaking: Breaking) -> str:
    if breaking.severity is not None:
        return f"{severity_text(stress, breaking.severity)} ({breaking.rules})"
    return f"> {severity_text(stress, breaking.furthest)}" if stress.ordered else "none"


def _point(stress: DictConfig, point: Point) -> dict[str, Any]:
    return {
        "severity": point.severity,
        "text": severity_text(stress, point.severity),
        "psnr": _numbers(point.psnr),
        "without": None if point.without_fallbacks is None else round(point.without_fallbacks, 2),
        "loss": None if point.loss is None else _numbers(point.loss),
        "failed": point.failed,
        "total": point.total,
        "suspect": point.suspect,
        "broken": point.broken,
        "silent": len(point.silent),
    }


def _numbers(estimate: Estimate) -> list[float | None]:
    return [None if value is None or not math.isfinite(value) else round(value, 3) for value in estimate]


def _pictures(stress: DictConfig, verdict: Verdict, study: Study, page: Path, views: int) -> list[dict[str, Any]]:
    """Per side that breaks: the first broken scene as it is clean and as it is broken."""
    found = []
    severities = [point.severity for point in verdict.points]
    for breaking in verdict.breaking:
        if breaking.severity is None or breaking.scene is None:
            continue
        runs = verdict.runs[severities.index(breaking.severity)]
        run = next((run for run in runs if _views(run, breaking.scene, views)), None)
        words = f"scene {breaking.scene} at {severity_text(stress, breaking.severity)}"
        if run is None:
            found.append(
                {"words": f"{words}: {runs[0].row.error or 'it left no pictures'}", "strip": None, "sheet": None}
            )
            continue
        clean = next((own for own in study.clean_runs.get(verdict.strategy, ()) if own.row.seed == run.row.seed), None)
        rows = [_views(each, breaking.scene, views) for each in (clean, run) if each is not None]
        found.append({"words": words, "strip": _strip(rows), "sheet": links(run, page).get("sheet")})
    return found


def _views(run: Run, scene: str, views: int) -> list[Path]:
    folder = run.file("predictions", str(run.row.strategy), scene, "rgb")
    paths = sorted(folder.glob("*.png")) if folder is not None else []
    return [paths[position] for position in spread(len(paths), views)]


def _strip(rows: Sequence[Sequence[Path]]) -> str | None:
    """Rows of small pictures as a data URL; None where one cannot be read."""
    try:
        lines = [
            np.concatenate([np.asarray(Image.open(path).convert("RGB")) for path in row], 1) for row in rows if row
        ]
        width = min(line.shape[1] for line in lines)
        file = io.BytesIO()
        strip = Image.fromarray(np.concatenate([line[:, :width] for line in lines]))
        strip.resize((2 * strip.width, 2 * strip.height), Image.Resampling.NEAREST).save(
            file, "WEBP", quality=WEBP_QUALITY
        )
    except (OSError, ValueError, SyntaxError):
        return None
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()
