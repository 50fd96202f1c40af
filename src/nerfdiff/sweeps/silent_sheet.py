"""Pictures of silent failures: what went in, what was to come out, and what did."""

from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from nerfdiff.metrics.image import psnr
from nerfdiff.metrics.predictions import read_prediction
from nerfdiff.metrics.score import truth_from
from nerfdiff.results.pictures import labelled_sheet
from nerfdiff.stability.silent import Silent
from nerfdiff.stress.stress import stress_of, with_stress
from nerfdiff.utils.errors import DataError

LETTERS = str.maketrans({"×": "x", "γ": "gamma", "σ": "sigma"})  # which the font of the sheets lacks


def silent_sheet(path: Path, found: Sequence[Silent]) -> Path | None:
    """Save a PNG with a strip per failure: the input with its stress, the truth of the view that is worst, the view.

    Returns:
        None where there is none that left pictures.

    Raises:
        DataError: a run's files are damaged, or the dataset is not there.
    """
    cells = {}
    for each in found:
        loss = f"{each.worst:.1f} dB ({each.failure.rules})"
        words = f"{each.words}: {each.strategy}, {each.failure.scene}, seed {each.failure.seed}, {loss}"
        if (strip := _strip(each)) is not None:
            cells[words.translate(LETTERS)] = strip
    return labelled_sheet(path, cells) if cells else None


def _strip(silent: Silent) -> torch.Tensor | None:
    """Return input, truth and view beside each other [3, h, 3w]; None where the run left no pictures."""
    run, scene = silent.run, silent.failure.scene
    folder = None if run is None else run.file("predictions", silent.strategy)
    job = None if folder is None else folder.parents[2] / ".hydra" / "config.yaml"
    if job is None or not job.is_file():
        return None
    cfg = OmegaConf.load(job)
    cfg.paths.output_dir = str(folder)  # Hydra knew it, and no longer does
    cfg = with_stress(cfg, "distill")
    data = instantiate(cfg.data)
    data.setup("test")
    prediction = read_prediction(folder, scene)
    truth = truth_from(data.reader("test"))(scene, prediction.views).images
    views = prediction.pixels.float() / 255
    worst = int(psnr(views, truth).argmin())
    scenes = data.test_set
    stress = stress_of(cfg)
    if stress is not None:
        stress.inputs(scenes)
    names = [data.reader("test").scene_id(index) for index in scenes.indices]
    if scene not in names:
        raise DataError(f"{folder / scene}: the dataset {data.reader('test').identity} has no such scene")
    batch = next(iter(data.scenes([names.index(scene)])))
    source = (batch if stress is None else stress.apply(batch)).source[0].cpu()
    return torch.cat([source, truth[worst], views[worst]], -1)
