"""The costs of predictions: fields of a row, from the records of each scene."""

import logging
from collections import Counter
from typing import Any

import pandas as pd
import torch

from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.predict import costs
from nerfdiff.evaluation.run import EvaluationRun
from nerfdiff.field import cpu_field
from nerfdiff.render import backend
from nerfdiff.results.row import Timing
from nerfdiff.stability.judge import OK
from nerfdiff.utils.timing import cost_of_a_piece, summarise

log = logging.getLogger(__name__)

TOLD = 100  # reasons of the judge in a row
SPENT = ("denoiser_calls", "field_queries", "steps", "steps_planned", "stopped_by")
PARTS = ("denoise", "fit", "guide")
STABILITY = ("nonfinite_grad_steps", "loss_spikes", "grad_norm_p99")


def cost_fields(run: EvaluationRun, strategy: Strategy) -> dict[str, Any]:
    """Return the cost fields of a row, with `model_fields`, the backend, K, fallbacks and the judge's verdict.

    A baseline, which runs no model, has counts alone.
    """
    scenes = scene_costs(run, strategy)
    fields = cost_totals(scenes, run.cost_key)
    if fields["field_queries"] == 0:
        return fields
    timing_s = cost_of_a_piece(run.device) * float(scenes["pieces"].mean())
    return fields | model_fields(run) | {"backend": _backend(run), "timing_s": timing_s}


def scene_costs(run: EvaluationRun, strategy: Strategy) -> pd.DataFrame:
    """Return a line for each scene: its costs, status and verdict."""
    return pd.DataFrame(costs(run, strategy))


def cost_totals(scenes: pd.DataFrame, conditions: str) -> dict[str, Any]:
    """Return those cost fields of a row that follow from `scene_costs`.

    Args:
        conditions: under which seconds and memory count, see `EvaluationRun.cost_key`.
    """
    fields: dict[str, Any] = _verdict(scenes["verdict"])
    fields |= {name: int(scenes[name].sum()) for name in ("denoiser_calls", "field_queries")}
    if fields["field_queries"] == 0:
        return fields
    # a run that went on elsewhere, or with other threads, has numbers of all its scenes, and seconds of these
    alike = scenes[scenes["conditions"] == conditions]
    fields["scene_s"] = _timing(alike, "seconds")
    fields |= {f"{name}_s": _timing(alike, name) for name in ("encode", "render")}
    fields |= _spent(scenes)
    if fields["denoiser_calls"]:
        fields |= {f"{name}_s": _timing(alike, name) for name in ("distill", *PARTS)}
    fields["peak_mem_bytes"] = int(alike["peak_mem_bytes"].max()) if len(alike) else None
    if "field_bytes" in scenes and scenes["field_bytes"].notna().all():
        fields["field_bytes"] = int(scenes["field_bytes"].sum())
    # of the views that were fitted, not of those asked for; a run may go on from one that did not write them down
    virtual = scenes["virtual_views"].dropna() if "virtual_views" in scenes else ()
    if len(virtual) and virtual.min() < virtual.max():
        log.warning("scenes had %d to %d virtual views; the row's K is the most", virtual.min(), virtual.max())
    fields["K"] = int(virtual.max()) if len(virtual) else None
    fallen = Counter(status for status in scenes["status"] if status != "ok")
    if fallen:
        fields["error"] = "fell back: " + ", ".join(f"{count} scenes {status}" for status, count in fallen.items())
    return fields | {"fallbacks": fallen.total()}


def _spent(scenes: pd.DataFrame) -> dict[str, Any]:
    """Return medians of what scenes took, and why they ended; a run may go on from one that did not write it down."""
    known = {name: scenes[name].dropna() for name in SPENT if name in scenes}
    fields: dict[str, Any] = {
        f"{name}_median": float(known[name].median())
        for name in ("denoiser_calls", "field_queries", "steps")
        if len(known.get(name, ()))
    }
    planned = known.get("steps_planned", ())
    fields["steps_planned"] = int(planned.max()) if len(planned) else None
    reasons = Counter(known.get("stopped_by", ()))
    return fields | {"stopped_by": ", ".join(f"{why} {count}" for why, count in reasons.most_common()) or None}


def _verdict(said: pd.Series) -> dict[str, Any]:
    """Count the scenes that the judge suspects, and say why; nothing where it did not look at all of them."""
    if said.isna().any():
        return {}
    suspect = Counter(verdict.removeprefix("suspect: ") for verdict in said if verdict != OK)
    commonest = sorted(suspect.items(), key=lambda item: (-item[1], item[0]))
    words = [f"{count} of {len(said)} {why}" for why, count in commonest[:TOLD]]
    if rest := sum(count for _, count in commonest[TOLD:]):
        words.append(f"{rest} more")  # a row has room for so many: see per_scene.csv
    told = "; ".join(words)
    return {"suspects": suspect.total(), "verdict": f"suspect: {told}" if told else OK}


def model_fields(run: EvaluationRun) -> dict[str, Any]:
    """Return the fields that describe the model, known before anything is computed."""
    model = run.model
    return {
        "model": model.name,
        "field": model.field_name,
        "params": model.parameter_count()["total"],
        "samples_per_ray": model.renderer.samples_per_ray,
        "compile": run.settings.compiled,
        "scenes_at_once": run.settings.scenes_at_once,
    } | {name: run.stability.get(name) for name in STABILITY}


def _timing(scenes: pd.DataFrame, name: str) -> Timing | None:
    """Summarise a time over the scenes after each process's first, which warms it up; over all if there is no other."""
    if name not in scenes:
        return None
    measured = scenes[scenes[name].notna()]
    warm = measured[measured["warm"] == True] if "warm" in measured else measured[:0]  # noqa: E712  (None is none)
    return summarise((warm if len(warm) else measured)[name].tolist())


@torch.no_grad()
def _backend(run: EvaluationRun) -> str:
    """Return the backend in use: `torch`, `triton`, or `cpu`, PyTorch in the order that suits a CPU."""
    model = run.model
    if model.renderer.backend == "torch":
        return "torch"
    scene = next(iter(run.load(run.scene_ids[:1]))).to(run.device)
    with run.autocast():
        field = model.field(model.encode(scene))
        rays = scene.target_cameras[:, 0].rays(scene.near, scene.far)
    chosen = backend.chosen(model.renderer, field, rays)
    if chosen == "torch" and model.renderer.backend == "auto" and cpu_field.suits(field, rays):
        return "cpu"
    return chosen
