"""Pictures of a run: a contact sheet and a video."""

from collections.abc import Sequence
from pathlib import Path

import torch

from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.predict import orbit_frames, saved_field
from nerfdiff.evaluation.run import EvaluationRun
from nerfdiff.metrics.predictions import read_prediction
from nerfdiff.metrics.score import truth_from
from nerfdiff.results.pictures import colour_depth, contact_sheet, orbit_video
from nerfdiff.stability.judge import OK
from nerfdiff.utils.spread import spread


def sheet(run: EvaluationRun, strategies: Sequence[Strategy], path: Path) -> Path:
    """Write a contact sheet: input, truth where it is known, and every strategy's predictions, of some views."""
    options = run.settings.sheet
    truth = truth_from(run.data.reader("test")) if run.data else None
    columns: dict[str, list[torch.Tensor]] = {}
    names = []

    def add(column: str, images: torch.Tensor) -> None:
        columns.setdefault(column, []).append(images)

    for batch in run.load(run.scene_ids[: options.scenes]):
        scene = batch.scene_ids[0]
        predictions = {s.name: read_prediction(run.predictions / s.name, scene) for s in strategies}
        main = predictions[strategies[0].name]
        shown = spread(len(main.views), options.views)
        suspect = " ?" if (main.verdict or OK) != OK else ""  # the row and the log say why
        names += [f"{scene[:10]} {main.views[i]}{suspect}" for i in shown]
        add("input", batch.source.expand(len(shown), -1, -1, -1))
        if truth:
            add("truth", truth(scene, [main.views[i] for i in shown]).images)
        for name, prediction in predictions.items():
            add(name, prediction.pixels[shown].float() / 255)
        if main.depth is not None:
            add("depth", colour_depth(main.depth[shown], float(batch.near), float(batch.far), main.opacity[shown]))
    return contact_sheet(path, {name: torch.cat(images) for name, images in columns.items()}, names)


def video(run: EvaluationRun, strategy: Strategy, path: Path) -> Path:
    """Write a video of a circle around the first scenes, side by side."""
    strips = [
        orbit_frames(run, strategy, scene.to(run.device), saved_field(run, strategy, scene.scene_ids[0]))
        for scene in run.load(run.scene_ids[: run.settings.orbit.scenes])
    ]
    return orbit_video(path, torch.cat(strips, -1), run.settings.orbit.fps)
