"""The costs of predictions: fields of a row, from the records of each scene."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import fmean, median
from typing import Any

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

PARTS = ("denoise", "fit", "guide")
STABILITY = ("nonfinite_grad_steps", "loss_spikes", "grad_norm_p99")


def cost_fields(run: EvaluationRun, strategy: Strategy) -> dict[str, Any]:
    """Return the cost fields of a row, with `model_fields`, the backend, K, fallbacks and the judge's verdict.

    A baseline, which runs no model, has counts alone.
    """
    scenes = costs(run, strategy)
    fields: dict[str, Any] = _verdict(scenes) | {
        "denoiser_calls": sum(int(cost["denoiser_calls"]) for cost in scenes),
        "field_queries": sum(int(cost["field_queries"]) for cost in scenes),
    }
    if fields["field_queries"] == 0:
        return fields
    # a run that went on elsewhere, or with other threads, has numbers of all its scenes, and seconds of these
    alike = [cost for cost in scenes if cost["conditions"] == run.cost_key]
    fields["scene_s"] = _timing(alike, "seconds")
    fields |= {f"{name}_s": _timing(alike, name) for name in ("encode", "render")}
    fields |= _spent(scenes)
    if fields["denoiser_calls"]:
        fields |= {f"{name}_s": _timing(alike, name) for name in ("distill", *PARTS)}
    fields["timing_s"] = cost_of_a_piece(run.device) * fmean(cost["pieces"] for cost in scenes)
    fields |= model_fields(run) | {"backend": _backend(run)}
    fields["peak_mem_bytes"] = max((cost["peak_mem_bytes"] for cost in alike), default=None)
    kept = [cost["field_bytes"] for cost in scenes]
    fields["field_bytes"] = None if None in kept else sum(kept)
    # of the views that were fitted, not of those asked for; a run may go on from one that did not write them down
    virtual = {cost["virtual_views"] for cost in scenes if cost.get("virtual_views") is not None}
    if len(virtual) > 1:
        log.warning("scenes had %d to %d virtual views; the row's K is the most", min(virtual), max(virtual))
    fields["K"] = max(virtual, default=None)
    fallen = Counter(cost["status"] for cost in scenes if cost["status"] != "ok")
    if fallen:
        fields["error"] = "fell back: " + ", ".join(f"{count} scenes {status}" for status, count in fallen.items())
    return fields | {"fallbacks": fallen.total()}


def _spent(scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return medians of what scenes took, and why they ended; a run may go on from one that did not write it down."""
    fields: dict[str, Any] = {}
    for name in ("denoiser_calls", "field_queries", "steps"):
        if counts := [cost[name] for cost in scenes if cost.get(name) is not None]:
            fields[f"{name}_median"] = float(median(counts))
    fields["steps_planned"] = max((cost["steps_planned"] for cost in scenes if cost.get("steps_planned")), default=None)
    reasons = Counter(cost["stopped_by"] for cost in scenes if cost.get("stopped_by"))
    return fields | {"stopped_by": ", ".join(f"{why} {count}" for why, count in reasons.most_common()) or None}


def _verdict(scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Count the scenes that the judge suspects, and say why; nothing where it did not look at all of them."""
    said = [scene["verdict"] for scene in scenes]
    if None in said:
        return {}
    suspect = Counter(why for verdict in said if verdict != OK for why in (verdict.removeprefix("suspect: "),))
    told = "; ".join(f"{count} of {len(said)} {why}" for why, count in suspect.items())
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


def _timing(scenes: list[dict[str, Any]], name: str) -> Timing | None:
    """Summarise a time over the scenes after each process's first, which warms it up; over all if there is no other."""
    measured = [cost for cost in scenes if name in cost]
    warm = [cost[name] for cost in measured if cost.get("warm")]
    return summarise(warm or [cost[name] for cost in measured])


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
