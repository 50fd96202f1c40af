"""Controls of the metrics: what each says of noise, repeats, an alien view, white, blur and truth."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.views import EvaluationScenes
from nerfdiff.metrics.predictions import PredictionWriter
from nerfdiff.metrics.score import Scorer, truth_from
from nerfdiff.metrics.table import METRICS
from nerfdiff.results.text import markdown_lines
from nerfdiff.stress.photo import defocus
from nerfdiff.stress.targets import replaced_views
from nerfdiff.utils.randomness import generator

Views = Float[Tensor, "views 3 height width"]
SHOWN = ("psnr", "ssim", "lpips", "st_lpips_vgg", "fid", "fd_st_vgg", "sharpness", "consistency_psnr")


def made_of(scene: ViewBatch, other: ViewBatch, alien_share: float, blur: float, seed: int) -> dict[str, Views]:
    """Return the views that the metrics are asked about, by name."""
    true, draws = scene.targets[0], generator("cpu", seed, "controls", *scene.scene_ids)
    alien = true.clone()
    replaced = replaced_views(len(true), alien_share)
    alien[replaced] = other.targets[0][replaced]
    return {
        "truth": true,
        "noise": torch.rand(true.shape, generator=draws),
        "one image repeated": true[:1].expand_as(true),
        "alien views": alien,
        "white": torch.ones_like(true),
        "blur": torch.stack([defocus(image, blur, draws) for image in true]),
    }


def controls(
    scenes: EvaluationScenes, scorer: Scorer, count: int, alien_share: float, blur: float, seed: int
) -> dict[str, dict[str, float | None]]:
    """Score views that are known to be good or bad, by the metrics' own names.

    Args:
        count: scenes, from the first on; an alien view is the same view of the scene before.
        alien_share: of views that are another scene's.
        blur: radius as a share of the width.
    """
    batches = [ViewBatch.collate([scenes[number]]) for number in range(min(count, len(scenes)))]
    made = [made_of(batch, batches[n - 1], alien_share, blur, seed) for n, batch in enumerate(batches)]
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in made[0]:
            plain = name.replace(" ", "_")
            writer = PredictionWriter(folder, plain, [batch.scene_ids[0] for batch in batches], {})
            for batch, views in zip(batches, made, strict=True):
                writer.write(batch.scene_ids[0], batch.target_views[0], views[name], batch.source_views)
            summary = scorer.score(writer.folder, truth_from(scenes.reader), Path(folder) / "scores" / plain)
            found[name] = {metric: summary.get(metric) for metric in SHOWN}
    return found


def controls_markdown(found: Mapping[str, Mapping[str, float | None]]) -> str:
    """A row per kind of views, a column per metric that was measured."""
    shown: Sequence[str] = [name for name in SHOWN if any(values.get(name) is not None for values in found.values())]
    rows = [["views", *(METRICS[name].heading for name in shown)]]
    for kind, values in found.items():
        cells = ["–" if values[name] is None else format(values[name], METRICS[name].format) for name in shown]
        rows.append([kind, *cells])
    return markdown_lines(rows)
