"""Predict scene after scene, and save predictions, fields and traces."""

import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.kept_steps import KeptSteps
from nerfdiff.distill.priors import all_cameras
from nerfdiff.distill.strategy import PredictedViews, Strategy
from nerfdiff.distill.trace import PLOT, TRACE, plot_trace, write_trace
from nerfdiff.evaluation.progress import SceneProgress
from nerfdiff.evaluation.run import EvaluationRun
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field, save_field, save_steps
from nerfdiff.metrics.image import psnr
from nerfdiff.metrics.predictions import SCENE, PredictionWriter
from nerfdiff.results.pictures import orbit_video
from nerfdiff.stability.judge import OK
from nerfdiff.trajectories import Upright, orbit
from nerfdiff.utils.errors import ConfigError, TimeUp, some
from nerfdiff.utils.memory import peak_memory
from nerfdiff.utils.timing import PartClock, Stopwatch

ORBIT = "orbit.mp4"

log = logging.getLogger(__name__)


def predict(run: EvaluationRun, strategy: Strategy, rank: int = 0, processes: int = 1) -> None:
    """Predict what is still to do of one process's share; a killed run loses at most the scenes in hand.

    After `minutes` no scene begins but the first; `require_all` raises where any is missing.

    Raises:
        ConfigError: numbers that cannot be.
    """
    if run.settings.scenes_at_once < 1:
        raise ConfigError(f"scenes_at_once={run.settings.scenes_at_once} must be at least 1")
    minutes = run.settings.minutes
    if minutes is not None and minutes <= 0:
        raise ConfigError(f"minutes={minutes} must be more than 0, or null")
    until = math.inf if minutes is None else time.monotonic() + 60 * minutes
    writer = _writer(run, strategy)
    share = writer.scenes[rank::processes]
    if run.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(run.device)
    to_do = set(writer.pending()).intersection(share)
    warm = False
    with SceneProgress(strategy.name, len(to_do), run.settings.progress_every if rank == 0 else None) as progress:
        # what another process is making comes last: by then it is done, or to be waited for
        for wait in (False, True):
            for group in _claimed(run, writer, share, wait):
                scenes = [scene.to(run.device) for scene in group]
                kept = KeptSteps(run.settings.keep_steps)
                callbacks = [*progress.callbacks(len(scenes)), *([kept] if kept.count else ())]
                watch, clock = Stopwatch(run.device), PartClock(run.device)
                with watch.measure(), clock.running(), run.autocast():
                    predicted = strategy.predict(run.model, scenes, run.settings.seed, callbacks)
                spent = _shares(watch.seconds[0], clock.seconds(), predicted) | {"warm": warm}
                warm = True
                for number, (scene, views) in enumerate(zip(scenes, predicted, strict=True)):
                    steps = kept.fields[number] if kept.fields else {}
                    score = _write(run, strategy, writer, scene, views, spent, steps)
                    writer.release(scene.scene_ids[0])
                    progress.advance("" if score is None else f"PSNR {score:.2f}")
                if time.monotonic() > until:
                    return


def _claimed(
    run: EvaluationRun, writer: PredictionWriter, share: Sequence[str], wait: bool
) -> Iterator[list[ViewBatch]]:
    """Yield groups of scenes to be fitted together, of those still to do that no other process makes."""
    to_do = set(writer.pending())
    pending = [scene for scene in share if scene in to_do]
    if wait and pending:
        log.info("another process is making %s: waiting for it", some(pending))
    loaded = (scene for scene in (run.load(pending) if pending else ()) if writer.claim(scene.scene_ids[0], wait))
    while group := list(islice(loaded, 1 if wait else run.settings.scenes_at_once)):
        yield group


def done(run: EvaluationRun, strategy: Strategy) -> str:
    """Return a sentence on how many scenes are complete."""
    writer = _writer(run, strategy)
    total = len(writer.scenes)
    return f"{total - len(writer.pending())} of {total} scenes of {strategy.name} are saved in {writer.folder}."


def require_all(run: EvaluationRun, strategy: Strategy) -> None:
    """Raise TimeUp where the minutes were spent before the last scene."""
    writer = _writer(run, strategy)
    if missing := len(writer.pending()):
        raise TimeUp(
            f"minutes={run.settings.minutes} were spent after {len(writer.scenes) - missing} of {len(writer.scenes)} "
            f"scenes of {strategy.name}; the same command goes on"
        )


def _shares(
    seconds: float, parts: Mapping[str, Sequence[float]], predicted: Sequence[PredictedViews]
) -> dict[str, float]:
    """Return seconds per encoding, per rendered view, and per scene of those made together."""
    spent = {"seconds": seconds, "pieces": sum(map(len, parts.values()))}
    spent |= {name: sum(pieces) for name, pieces in parts.items()}
    of = {"encode": len(parts.get("encode", ())), "render": sum(len(views.images) for views in predicted)}
    shares = {name: value / of.get(name, len(predicted)) for name, value in spent.items()}
    # of the input image; what is encoded on the way, and rendered to be guided by, is part of the distillation
    rest = shares.get("encode", 0.0) + spent.get("render", 0.0) / len(predicted)
    return shares | {"distill": shares["seconds"] - rest}


def _write(
    run: EvaluationRun,
    strategy: Strategy,
    writer: PredictionWriter,
    scene: ViewBatch,
    views: PredictedViews,
    spent: Mapping[str, float],
    steps: Mapping[int, RefinedField],
) -> float | None:
    """Save one scene's views, what was `spent` on it (see `_shares`), and fields of some steps of its distillation.

    Returns:
        the views' PSNR, if there is a truth.
    """
    verdict, signs = None, None
    if run.judge is not None and views.field_queries > 0:  # of baselines, which ask no model, it knows nothing
        with run.autocast():
            signs = run.judge.signs(run.model, scene, views, run.familiar, run.settings.seed)
        verdict = run.judge.verdict(signs, views.status)
        if verdict != OK:
            log.warning("%s of scene %s is %s", strategy.name, scene.scene_ids[0], verdict)
    writer.write(
        scene.scene_ids[0],
        scene.target_views[0],
        views.images,
        scene.source_views,
        depth=views.depth,
        opacity=views.opacity,
        cost={
            **spent,
            "conditions": run.cost_key,
            "peak_mem_bytes": _peak_memory(run.device),
            "denoiser_calls": views.denoiser_calls,
            "field_queries": views.field_queries,
            **{name: getattr(views, name) for name in ("virtual_views", "steps", "steps_planned", "stopped_by")},
        },
        status=views.status,
        verdict=verdict,
        signs=signs,
        beside=partial(_leave, run, strategy, scene, views, steps),
    )
    return psnr(views.images.clamp(0, 1), scene.targets[0]).mean().item() if run.data else None


def _leave(
    run: EvaluationRun,
    strategy: Strategy,
    scene: ViewBatch,
    views: PredictedViews,
    steps: Mapping[int, RefinedField],
    folder: Path,
) -> None:
    """Write the field, its trace and an orbit into the scene's folder; a field that was fitted in any case."""
    if views.field is not None and (views.trace or run.settings.per_scene):
        stands = Upright.seen_by(all_cameras(scene)).to("cpu")
        save_field(folder / FIELD, saved := replace(views.field, stands=stands))
        save_steps(folder, saved, steps)
    if not run.settings.per_scene:
        return
    if views.trace:
        write_trace(folder / TRACE, views.trace)
        plot_trace(folder / PLOT, views.trace)
    if run.settings.orbit.frames > 0:
        orbit_video(folder / ORBIT, orbit_frames(run, strategy, scene, views.field), run.settings.orbit.fps)


@torch.no_grad()
def orbit_frames(run: EvaluationRun, strategy: Strategy, scene: ViewBatch, saved: SavedField | None) -> torch.Tensor:
    """Render a circle around the object [frames, 3, height, width], or predict it where there is no field."""
    cameras = orbit(scene.source_cameras, scene.target_cameras[0], run.settings.orbit.frames)[None]
    if saved is not None:
        field = saved.field.to(run.device)
        return field.render(saved.renderer, cameras).images[0].cpu()
    frames = scene.source_pixels[:, None].expand(-1, cameras.shape[1], -1, -1, -1)
    view = replace(scene, target_cameras=cameras, target_pixels=frames, target_depth=None, target_mask=None)
    with run.autocast():
        (views,) = strategy.predict(run.model, [view], run.settings.seed)
    return views.images.cpu()


def saved_field(run: EvaluationRun, strategy: Strategy, scene_id: str) -> SavedField | None:
    """Load the field that `predict` saved, if the strategy has one and it was kept."""
    path = run.predictions / strategy.name / scene_id / FIELD
    return load_field(path) if path.is_file() else None


def costs(run: EvaluationRun, strategy: Strategy) -> list[dict[str, Any]]:
    """Return each scene's costs, status and verdict."""
    folder = _writer(run, strategy).folder
    facts = [(folder / scene, json.loads((folder / scene / SCENE).read_text())) for scene in run.scene_ids]
    return [
        fact["cost"] | {"status": fact["status"], "verdict": fact.get("verdict"), "field_bytes": _size(where / FIELD)}
        for where, fact in facts
    ]


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def _peak_memory(device: torch.device) -> int:
    """Return peak bytes so far: allocated on a GPU; on a CPU the process's resident set, imports included."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return peak_memory()


def _writer(run: EvaluationRun, strategy: Strategy) -> PredictionWriter:
    return PredictionWriter(run.predictions, strategy.name, run.scene_ids, run.identity)
