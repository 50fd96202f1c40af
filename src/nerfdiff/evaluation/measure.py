"""Predictions to a row of results."""

import json
import logging
import os
import shlex
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import filelock
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfdiff.cli import SEARCHPATH, command_words
from nerfdiff.data.scene import SceneReader
from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.costs import cost_fields, model_fields, scene_costs
from nerfdiff.evaluation.dashboard import show_in_dashboard
from nerfdiff.evaluation.run import EvaluationRun, RunSettings, choose_device
from nerfdiff.metrics.predictions import NonFinitePrediction
from nerfdiff.metrics.score import Scorer, truth_from
from nerfdiff.results.environment import environment
from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.utils.errors import ConfigError, TimeUp, is_out_of_memory
from nerfdiff.utils.files import atomic, encode, write_text
from nerfdiff.utils.hashes import sha256_values

log = logging.getLogger(__name__)

COSTS, SHARD = "costs.csv", "shard.json"


def measure(run: EvaluationRun, strategy: Strategy, scorer: Scorer, reader: SceneReader) -> ResultRow:
    """Score the predictions of one strategy and append its row; a baseline without a model has no times.

    Of several processes that made the scenes side by side, the first appends the row.
    """
    scores = run.folder / "scores" / strategy.name
    shard = run.settings.shard
    summary = scorer.score(run.predictions / strategy.name, truth_from(reader), scores, run.device, shard)
    row = replace(_identified(run, strategy), **summary, **cost_fields(run, strategy))
    if row.fallbacks:
        log.warning("%s %s of %d", strategy.name, row.error, row.n_scenes)
        # where every scene fell back, the numbers are of the fields that distillation began with
        row = replace(row, status="diverged" if row.fallbacks == row.n_scenes else "ok")
    if shard is not None:
        write_shard(scores, run, strategy, row)
    with filelock.FileLock(run.folder / ".row.lock"):
        if _is_appended(run, row):
            log.info("another process, which made these scenes too, has appended the row of %s", row.run_id)
        else:
            append_row(run.settings.results, row)
    return row


def _is_appended(run: EvaluationRun, row: ResultRow) -> bool:
    """Return true if a row like this one was appended since this run began."""
    results = run.settings.results
    if not results.is_file():
        return False
    with open(results, "rb") as file:
        file.seek(run.rows_before)
        for line in file:
            with suppress(ValueError):
                other = json.loads(line)
                if isinstance(other, dict) and (other.get("run_id"), other.get("status")) == (row.run_id, row.status):
                    return True
    return False


def config_sha256(identity: Mapping[str, Any], cost_key: str, strategy: str, scoring: Mapping[str, Any]) -> str:
    """A digest of all that a row's numbers depend on: what is predicted, what it costs, how it is scored."""
    return sha256_values([identity, cost_key, strategy, scoring])


def write_shard(scores: Path, run: EvaluationRun, strategy: Strategy, row: ResultRow) -> None:
    """Leave beside a shard's scores what merging it takes; `SHARD` last, which says that the shard is complete."""
    columns = scene_costs(run, strategy)
    with atomic(scores / COSTS) as temporary:
        columns.to_csv(temporary, index=False)
    facts = {"identity": run.identity, "cost_key": run.cost_key, "strategy": strategy.name}
    facts |= {"scoring": run.settings.scoring, "scenes": run.scene_ids, "row": asdict(row)}
    write_text(scores / SHARD, json.dumps(encode(facts)) + "\n")


def record_failure(
    cfg: DictConfig, error: Exception, run: EvaluationRun | None, strategy: Strategy | None
) -> ResultRow:
    """Append the row of a run that failed, with its status; after an early failure it has few other fields."""
    if run is not None and strategy is not None:
        row = replace(_identified(run, strategy), **model_fields(run))
    else:
        name = strategy.name if strategy is not None else cfg.strategy.name
        asked = _asked_for(RunSettings.of(cfg))
        row = ResultRow(run_id=f"{cfg.run_name}/{name}", strategy=name, **asked, **_environment(cfg))
    status = "error"
    if isinstance(error, NonFinitePrediction):
        status = "nan"
    elif is_out_of_memory(error):
        status = "oom"
    elif isinstance(error, TimeUp):
        status = "timeout"
    row = replace(row, status=status, error=str(error))
    append_row(cfg.results, row)
    show_in_dashboard(cfg, [row])
    return row


def _identified(run: EvaluationRun, strategy: Strategy) -> ResultRow:
    """Make the row of a run, before anything is measured."""
    settings = run.settings
    config_hash = config_sha256(run.identity, run.cost_key, strategy.name, settings.scoring)
    prior = getattr(strategy, "prior", None)
    return ResultRow(
        run_id=f"{settings.run_name}/{strategy.name}-{config_hash[:8]}",
        config_sha256=config_hash,
        folder=os.path.relpath(run.folder, settings.results.parent),
        strategy=strategy.name,
        prior=prior and type(prior).__name__,
        **_asked_for(settings),
        **environment(run.device, run.precision),
        **{key: run.identity[key] for key in ("ckpt_sha256", "weights", "split_sha256", "image_size")},
    )


def _asked_for(settings: RunSettings) -> dict[str, Any]:
    """Return the fields that the settings and the command tell."""
    known = {name: getattr(settings, name) for name in ("seed", "dataset", "stress", "severity", "neutral")}
    known["shard"] = settings.shard and str(settings.shard)
    if not HydraConfig.initialized():
        return known
    return known | {"overrides": list(HydraConfig.get().overrides.task), "command": _command(HydraConfig.get())}


def _command(hydra: DictConfig) -> str:
    """Return the shell command that repeats this job, from the project's folder or as installed."""
    words = command_words(hydra.job.config_name)
    if any(word.startswith("sweep=") for word in hydra.overrides.task):
        words.append("hydra.mode=RUN")  # the settings of a sweep's jobs, and not the sweep again
    given = [source for source in hydra.runtime.config_sources if "command-line" in source.provider]
    if folders := [f"{source.schema}://{source.path}" for source in given]:  # of configs: --config-dir and the like
        words.append(f"{SEARCHPATH}={json.dumps(folders)}")
    return shlex.join([*words, *hydra.overrides.task])


def _environment(cfg: DictConfig) -> dict[str, Any]:
    """Return the environment of a run that failed before it had a device, as far as it is known."""
    try:
        return environment(choose_device(cfg.device), None if cfg.precision == "auto" else cfg.precision)
    except ConfigError:
        return {}
