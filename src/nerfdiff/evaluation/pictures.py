"""What a run leaves for the eye: a contact sheet and a video."""

from collections.abc import Sequence
from pathlib import Path

import torch

from nerfdiff.distill.strategy import Strategy
from nerfdiff.evaluation.predict import orbit_frames, saved_field
from nerfdiff.evaluation.subject import Subject
from nerfdiff.metrics.predictions import read_prediction
from nerfdiff.metrics.score import truth_from
from nerfdiff.results.pictures import colour_depth, contact_sheet, orbit_video


def sheet(subject: Subject, strategies: Sequence[Strategy], path: Path) -> Path:
    """Input, truth where it is known, and every strategy's prediction of some views of some scenes."""
    options = subject.cfg.sheet
    truth = truth_from(subject.data.reader("test")) if subject.data else None
    columns: dict[str, list[torch.Tensor]] = {}
    names = []

    def add(column: str, images: torch.Tensor) -> None:
        columns.setdefault(column, []).append(images)

    for batch in subject.load(subject.scene_ids[: options.scenes]):
        scene = batch.scene_ids[0]
        predictions = {s.name: read_prediction(subject.predictions / s.name, scene) for s in strategies}
        main = predictions[strategies[0].name]
        n = len(main.views)
        shown = [(2 * i + 1) * n // (2 * options.views) for i in range(min(n, options.views))]
        names += [f"{scene[:10]} {main.views[i]}" for i in shown]
        add("input", batch.source.expand(len(shown), -1, -1, -1))
        if truth:
            add("truth", truth(scene, [main.views[i] for i in shown]).images)
        for name, prediction in predictions.items():
            add(name, prediction.pixels[shown].float() / 255)
        if main.depth is not None:
            add("depth", colour_depth(main.depth[shown], float(batch.near), float(batch.far), main.opacity[shown]))
    return contact_sheet(path, {name: torch.cat(images) for name, images in columns.items()}, names)


def video(subject: Subject, strategy: Strategy, path: Path) -> Path:
    """A circle around the first scenes, side by side."""
    strips = [
        orbit_frames(subject, strategy, scene.to(subject.device), saved_field(subject, strategy, scene.scene_ids[0]))
        for scene in subject.load(subject.scene_ids[: subject.cfg.orbit.scenes])
    ]
    return orbit_video(path, torch.cat(strips, -1), subject.cfg.orbit.fps)
