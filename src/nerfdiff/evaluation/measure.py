"""Predictions to a row of results."""

import logging
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfdiff.data.scene import SceneReader
from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.predict import costs
from nerfdiff.evaluation.subject import Subject
from nerfdiff.metrics.predictions import NonFinitePrediction
from nerfdiff.metrics.score import Scorer, truth_from
from nerfdiff.results.environment import environment
from nerfdiff.results.hashes import sha256_values
from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.results.timing import summarise, time_calls
from nerfdiff.training import plain

log = logging.getLogger(__name__)


def measure(subject: Subject, strategy: Strategy, scorer: Scorer, reader: SceneReader) -> ResultRow:
    """Score the predictions of one strategy and append its row; one that has no model is timed by nothing."""
    scores = subject.folder / "scores" / strategy.name
    summary = scorer.score(subject.predictions / strategy.name, truth_from(reader), scores, subject.device)
    row = replace(_identified(subject, strategy), **summary, **_cost(subject, strategy))
    append_row(subject.cfg.results, row)
    return row


def record_failure(cfg: DictConfig, error: Exception, subject: Subject | None, strategy: Strategy | None) -> ResultRow:
    """A run that failed is a row too, with its status; where it failed early, little else is known of it."""
    if subject is not None and strategy is not None:
        row = _identified(subject, strategy)
    else:
        name = strategy.name if strategy is not None else cfg.strategy.name
        row = ResultRow(run_id=f"{cfg.run_name}/{name}", overrides=_overrides(), seed=cfg.seed, strategy=name)
    status = "error"
    if isinstance(error, NonFinitePrediction):
        status = "nan"
    elif isinstance(error, torch.cuda.OutOfMemoryError | MemoryError):
        status = "oom"
    row = replace(row, status=status, error=str(error))
    append_row(cfg.results, row)
    return row


def _identified(subject: Subject, strategy: Strategy) -> ResultRow:
    """A row that says what was run, and of which nothing is measured yet."""
    cfg = subject.cfg
    # What the numbers depend on: the identity of the predictions, the strategy and how it is scored.
    config_hash = sha256_values([subject.identity, strategy.name, plain(cfg.metrics)])
    prior = getattr(strategy, "prior", None)
    return ResultRow(
        run_id=f"{cfg.run_name}/{strategy.name}-{config_hash[:8]}",
        config_sha256=config_hash,
        folder=os.path.relpath(subject.folder, Path(cfg.results).parent),
        overrides=_overrides(),
        seed=cfg.seed,
        dataset=f"{cfg.data.name}/{cfg.data.test_split}",
        strategy=strategy.name,
        prior=prior and type(prior).__name__,
        K=prior and prior.views,
        **environment(subject.device, subject.precision),
        **{key: subject.identity[key] for key in ("ckpt_sha256", "weights", "split_sha256", "image_size")},
    )


def _overrides() -> list[str] | None:
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else None


def _cost(subject: Subject, strategy: Strategy) -> dict[str, Any]:
    """The cost fields of the row, and how many scenes fell back."""
    scenes = costs(subject, strategy)
    fields: dict[str, Any] = {
        "denoiser_calls": sum(int(cost["denoiser_calls"]) for cost in scenes),
        "field_queries": sum(int(cost["field_queries"]) for cost in scenes),
    }
    if fields["field_queries"] == 0:
        return fields  # a baseline: no model ran
    fields |= _model_timings(subject) | {"peak_mem_bytes": max(cost["peak_mem_bytes"] for cost in scenes)}
    fields["params"] = subject.model.parameter_count()["total"]
    if fields["denoiser_calls"]:
        # The first batch of scenes warms up, unless it is the only one.
        seconds = [cost["seconds"] for cost in scenes]
        fields["distill_s"] = summarise(seconds[scenes[0]["together"] :] or seconds)
    fallen = Counter(cost["status"] for cost in scenes if cost["status"] != "ok")
    if fallen:
        fields["error"] = "fell back: " + ", ".join(f"{count} scenes {status}" for status, count in fallen.items())
        log.warning("%s %s of %d", strategy.name, fields["error"], len(scenes))
    return fields | {"fallbacks": fallen.total()}


@torch.no_grad()
def _model_timings(subject: Subject) -> dict[str, Any]:
    """Seconds to encode one image and to render one view, the quantities of the paper's speed table."""
    scene, model = next(iter(subject.load(subject.scene_ids[:1]))).to(subject.device), subject.model
    repeats = {"n": subject.cfg.timing.repeats, "warmup": subject.cfg.timing.warmup, "device": subject.device}
    with subject.autocast():
        inputs = (scene.source, scene.source_cameras, scene.near, scene.far)
        encoding = model.encode(*inputs)
        camera = scene.target_cameras[:, :1]
        return {
            "encode_s": time_calls(lambda: model.encode(*inputs), **repeats),
            "render_s": time_calls(lambda: model.render(encoding, camera), **repeats),
        }
