"""Calibration: what the metrics say of failures, what a model's training images look like, and the judge's limits."""

import logging
from dataclasses import replace
from pathlib import Path

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.checkpoint import load_model
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.scene import Listing
from nerfdiff.evaluation.controls import controls, controls_markdown
from nerfdiff.results.frame import find_results, read_runs
from nerfdiff.stability.elevation import Elevation, framed
from nerfdiff.stability.familiar import FAMILIAR, Familiar, measured
from nerfdiff.stability.limits import fit_limits, halves, limits_text, samples_of
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import write_text
from nerfdiff.utils.randomness import generator

log = logging.getLogger(__name__)


def calibrate(cfg: DictConfig) -> None:
    """Do `cfg.part`.

    Raises:
        ConfigError: another part, or what it needs is not given.
        UserError: bad data or checkpoint.
    """
    parts = {"controls": _controls, "familiar": _familiar, "judge": _judge}
    if cfg.part not in parts:
        raise ConfigError(f"part={cfg.part}: choose {', '.join(parts)}")
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    parts[cfg.part](cfg)


def _controls(cfg: DictConfig) -> None:
    data = instantiate(cfg.data)
    data.setup("test")
    found = controls(data.test_set, instantiate(cfg.metrics), cfg.first_scenes, cfg.alien_share, cfg.blur, cfg.seed)
    text = controls_markdown(found)
    if cfg.out is not None:
        write_text(Path(cfg.out), text)
    print(text)


def _familiar(cfg: DictConfig) -> None:
    loaded = load_model(cfg.ckpt, cfg.weights, cfg.paths.assets_dir, {})
    reader = instantiate(cfg.data).reader("train")
    draws = generator("cpu", cfg.seed, "familiar")
    degrees = []

    def batches():
        for number, index in enumerate(torch.randint(len(reader), (cfg.images,), generator=draws).tolist()):
            view = int(torch.randint(len(reader.view_names(index)), (), generator=draws))
            degrees.append(_elevations(reader.listing(index))[view])
            yield ViewBatch.collate([Sample(reader.load(index, [view]), source=0, targets=[0], draw=number)])

    seen = list(batches())
    found, known = measured(loaded.model, seen)
    familiar = Familiar.of(found, cfg.kept, known)
    shown, _ = measured(loaded.model, (framed(batch, familiar.framing()) for batch in seen))
    familiar = replace(familiar, elevation=Elevation.of(shown, torch.stack(degrees)))
    if (elevation := familiar.elevation) is not None:
        log.info(
            "elevations of training images held out are missed by %.1f degrees on average, 9 of 10 by at most %.1f; "
            "their median by %.1f on average",
            elevation.error,
            elevation.most,
            elevation.spread,
        )
    path = Path(cfg.out) if cfg.out is not None else loaded.path.parent / FAMILIAR
    familiar.save(path)
    log.info("what %d training images look like: %s", cfg.images, path)


def _elevations(listing: Listing) -> Float[Tensor, "views"]:
    """Degrees from which the level views of a scene look at what all look at; NaN where there is one view alone."""
    c2w = torch.from_numpy(listing.c2w).float()
    if len(c2w) < 2:
        return torch.full((1,), torch.nan)
    cameras = Cameras(c2w, torch.eye(3).expand(len(c2w), 3, 3), 1, 1)
    return Upright.seen_by(cameras).elevation(cameras)


def _judge(cfg: DictConfig) -> None:
    if cfg.results is None:
        raise ConfigError("part=judge needs results=<the folder of a sweep=stability>")
    runs = [run for path in find_results(cfg.results) for run in read_runs(path)]
    rules = instantiate(cfg.verdicts.rules)
    samples = samples_of(runs, rules)
    fitted_on, tested_on = halves(samples)
    limits = fit_limits(fitted_on, cfg.false_alarms, cfg.steps, cfg.margin)
    print(limits_text(limits, fitted_on, tested_on))
