"""Pictures of a sweep: some views of some scenes, as every row of its table has them."""

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from nerfdiff.metrics.predictions import Prediction, read_plan, read_prediction
from nerfdiff.metrics.score import Truth, truth_from
from nerfdiff.results.pictures import contact_sheet
from nerfdiff.sweeps.jobs import Group, shown_predictions
from nerfdiff.utils.errors import UserError
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)


def grid(path: Path, sweep: DictConfig, groups: Sequence[Group]) -> Path | None:
    """Save input and truth, where the dataset can still be read, and the first seed's predictions of every group.

    Returns:
        `path`; None where no job left predictions of the same views.
    """
    shown = shown_predictions(groups)
    if not shown:
        return None
    scenes = [read_plan(folder)["scenes"] for folder in shown.values()]
    common = [scene for scene in scenes[0] if all(scene in others for others in scenes)][: sweep.sheet.scenes]
    truth = _truth(sweep)
    columns: dict[str, list[torch.Tensor]] = {}
    names: list[str] = []
    for scene in common:
        predictions = {name: read_prediction(folder, scene) for name, folder in shown.items()}
        first = next(iter(predictions.values()))
        views = [view for view in first.views if all(view in p.views for p in predictions.values())]
        views = [views[position] for position in spread(len(views), sweep.sheet.views)]
        names += [f"{scene[:10]} {view}" for view in views]
        if truth is not None:
            source = truth(scene, first.source_views[:1]).images
            columns.setdefault("input", []).append(source.expand(len(views), -1, -1, -1))
            columns.setdefault("truth", []).append(truth(scene, views).images)
        for name, prediction in predictions.items():
            columns.setdefault(name, []).append(_images(prediction, views))
    if not names:
        return None
    return contact_sheet(path, {name: torch.cat(images) for name, images in columns.items()}, names)


def _images(prediction: Prediction, views: Sequence[str]) -> torch.Tensor:
    return prediction.pixels[[prediction.views.index(view) for view in views]].float() / 255


def _truth(sweep: DictConfig) -> Truth | None:
    try:
        data = instantiate(sweep.data)
        data.setup("test")
        return truth_from(data.reader("test"))
    except UserError as error:
        log.warning("the pictures are without input and truth: %s", error)
        return None
