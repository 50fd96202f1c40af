"""A stress: one thing that goes wrong, by so much (`conf/stress`)."""

import copy
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.scene import SceneReader
from nerfdiff.data.views import EvaluationScenes
from nerfdiff.distill.priors import Prior, all_cameras
from nerfdiff.distill.strategy import Strategy
from nerfdiff.limits import check_limits
from nerfdiff.stress.targets import AlienViews
from nerfdiff.stress.training import FaultyReader
from nerfdiff.trajectories import look_at_point
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.randomness import generator

log = logging.getLogger(__name__)

Load = Callable[[Sequence[str]], Iterable[ViewBatch]]
FUNCTIONS = ("image", "scene", "prior", "targets", "input_view", "training")
"""What a stress may act on, beside settings."""


@dataclass(frozen=True)
class Stress:
    """A stress of an axis, of a severity that is not the neutral one.

    Args:
        axis: its name.
        severity: in the axis's own unit.
        seed: of what it draws.
        neutral: the severity that is none; None where every one is some.
        image: acts on the input image.
        scene: acts on a scene's input camera and bounds.
        prior: acts on the virtual views' cameras.
        targets: true where views of another scene stand among a field's targets.
        input_view: chooses another view as the input.
        training: a fault of training scenes.
    """

    axis: str
    severity: float
    seed: int
    neutral: float | None = None
    image: Callable | None = None
    scene: Callable | None = None
    prior: Callable | None = None
    targets: bool | None = None
    input_view: Callable | None = None
    training: Callable[[SceneReader, float, int], SceneReader] | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """What predictions depend on, for a run's identity; a stress of settings is in them."""
        acts = any(getattr(self, name) is not None for name in FUNCTIONS)
        return {"stress": [self.axis, self.severity]} if acts else {}

    def inputs(self, scenes: EvaluationScenes) -> None:
        """Choose the input views of scenes.

        Raises:
            DataError: a scene has no such view.
        """
        if self.input_view is None:
            return
        for position, (index, own) in enumerate(zip(scenes.indices, scenes.sources, strict=True)):
            c2w = torch.from_numpy(scenes.reader.listing(index).c2w).float()
            cameras = Cameras(c2w, torch.eye(3).expand(len(c2w), 3, 3), 1, 1)
            view = self.input_view(cameras, own, self.severity)
            if view is None:
                raise DataError(
                    f"stress={self.axis} stress.severity={self.severity:g}: no view of scene "
                    f"{scenes.reader.scene_id(index)} is near enough; make scenes that have one (docs/stability.md), "
                    "and set data.root to them"
                )
            scenes.sources[position] = view

    def on(self, load: Load) -> Load:
        """Return a function that loads scenes with this stress on their input."""
        if self.image is None and self.scene is None:
            return load
        return lambda names: (self.apply(batch) for batch in load(names))

    def apply(self, batch: ViewBatch) -> ViewBatch:
        """Stress the input of a batch of one scene."""
        if self.image is not None:
            draws = generator("cpu", self.seed, "stress", self.axis, *batch.scene_ids)
            image = self.image(batch.source[0].cpu(), self.severity, draws)
            pixels = (image.clamp(0, 1) * 255).round().byte()[None].to(batch.source_pixels.device)
            batch = replace(batch, source_pixels=pixels)
        return batch if self.scene is None else self.scene(batch, self.severity)

    def strategy(self, strategy: Strategy, load: Load, scene_ids: Sequence[str]) -> Strategy:
        """Return the strategy with this stress on its virtual views' cameras, or on its targets.

        Raises:
            ConfigError: there is no other scene for its views to be of.
        """
        if self.prior is not None and hasattr(strategy, "prior"):
            strategy = replace(strategy, prior=StressedPrior(strategy.prior, self))
        if self.input_view is not None and hasattr(getattr(strategy, "prior", None), "source_view"):
            strategy = replace(strategy, prior=_FromInput(strategy.prior))
        if self.targets and hasattr(strategy, "teacher"):
            if len(scene_ids) < 2:
                raise ConfigError(f"stress={self.axis} takes views of another scene: it needs at least two scenes")
            of = {name: scene_ids[number - 1] for number, name in enumerate(scene_ids)}
            strategy = replace(strategy, teacher=_Alien(strategy.teacher, self.severity, load, of))
        return strategy

    def reader(self, reader: SceneReader) -> SceneReader:
        """Return the training split with faulty scenes."""
        return reader if self.training is None else self.training(reader, self.severity, seed=self.seed)


@dataclass(frozen=True)
class StressedPrior:
    """The virtual views' cameras of a prior, with an error in each."""

    prior: Prior
    stress: Stress

    def __call__(self, scene: ViewBatch) -> Cameras:
        cameras = self.prior(scene)
        draws = generator("cpu", self.stress.seed, "stress", self.stress.axis, *scene.scene_ids)
        distance = float(look_at_point(all_cameras(scene)).norm()) if scene.target_cameras.shape[1] > 1 else None
        if distance is None:
            distance = float(scene.near[0] + scene.far[0]) / 2
        return self.stress.prior(cameras, self.stress.severity, draws, distance)


@dataclass(frozen=True)
class _FromInput:
    """A prior of numbered views, told which of them the scene's input is."""

    prior: Prior

    def __call__(self, scene: ViewBatch) -> Cameras:
        return replace(self.prior, source_view=int(scene.source_views[0]))(scene)


@dataclass(frozen=True)
class _Alien:
    """Make a scene's teacher with views of the scene before it, the first one's being the last."""

    make: Callable
    share: float
    load: Load
    of: dict[str, str]

    def __call__(self, views) -> AlienViews:
        scene = next(name for name in views.seed if name in self.of)
        other = next(iter(self.load([self.of[scene]])))
        return AlienViews(self.make(views), self.share, other.targets[0])


def stress_of(cfg: DictConfig) -> Stress | None:
    """Build the stress of a config; None where it has none, or the neutral severity.

    Raises:
        ConfigError: a severity that is no number.
    """
    stress = cfg.stress
    if not _active(stress):
        return None
    functions = {name: stress[name] for name in FUNCTIONS if stress[name] is not None}
    built = {name: node if isinstance(node, bool) else instantiate(node) for name, node in functions.items()}
    return Stress(stress.axis, stress.severity, cfg.seed, stress.neutral, **built)


def row_fields(stress: Stress | None) -> dict[str, Any]:
    """Return a row's fields of a stress; all None where there is none."""
    if stress is None:
        return dict.fromkeys(("stress", "severity", "neutral"))
    neutral = None if stress.neutral is None else float(stress.neutral)
    return {"stress": stress.axis, "severity": float(stress.severity), "neutral": neutral}


def with_stress(cfg: DictConfig, command: str) -> DictConfig:
    """Return a config with the settings that its stress changes, where it has one.

    `stress.settings` sets keys, `stress.factors` multiplies numbers, and `stress.at` has settings by severity. Keys
    that the config lacks, as a strategy that fits no field lacks learning rates, stay away: the stress does not act,
    and a log line says so.

    Args:
        command: `distill` (evaluate.py too) or `train`.

    Raises:
        ConfigError: the stress is of the other command, `stress.at` does not have this severity, or a number comes out
            that no run can have.
    """
    stress = cfg.stress
    if not _active(stress):
        return cfg
    if stress.where != command:
        raise ConfigError(f"stress={stress.axis} is of {stress.where}.py: choose another, or stress=none")
    if stress.needs and not any(_has(cfg, key) for key in stress.needs):
        log.warning("stress=%s does not act here: there is no %s", stress.axis, " or ".join(stress.needs))
    changes = dict(stress.settings)
    if stress.at:
        by_severity = {float(key): value for key, value in stress.at.items()}
        if float(stress.severity) not in by_severity:
            known = ", ".join(f"{severity:g}" for severity in by_severity)
            raise ConfigError(f"stress.severity={stress.severity}: stress={stress.axis} has {known}")
        changes |= dict(by_severity[float(stress.severity)])
    for key, factor in stress.factors.items():
        if (value := OmegaConf.select(cfg, key)) is not None:
            changes[key] = value * factor
    changed = copy.deepcopy(cfg)
    changed.stress.neutral = stress.neutral  # which may be one of the keys that change
    for key, value in changes.items():
        if _has(cfg, key):
            OmegaConf.update(changed, key, value)
    check_limits(changed)
    return changed


def _active(stress: DictConfig) -> bool:
    return stress.axis != "none" and stress.severity is not None and stress.severity != stress.neutral


def _has(cfg: DictConfig, key: str) -> bool:
    parent, _, last = key.rpartition(".")
    node = OmegaConf.select(cfg, parent) if parent else cfg
    return isinstance(node, DictConfig) and last in list(node)


def stressed_readers(make_reader: Callable[..., SceneReader], stress: Stress, split: str) -> Callable[..., SceneReader]:
    """Return a maker of readers of which that of the training `split` has faulty scenes."""

    def make(**settings: Any) -> SceneReader:
        reader = make_reader(**settings)
        return stress.reader(reader) if settings["split"] == split else reader

    return make


def faulty(reader: SceneReader, share: float, seed: int, fault: Callable | None) -> FaultyReader:
    """See `FaultyReader`."""
    return FaultyReader(reader, share, fault, seed)
