"""An evaluation run: a model, scenes, settings, and all that predictions of one run share."""

import copy
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from nerfdiff.checkpoint import load_model
from nerfdiff.compilation import compile_unets
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.diffusion.denoiser import cast_products
from nerfdiff.diffusion.layout import channels_last
from nerfdiff.distill.strategy import Strategy
from nerfdiff.exported_model import LoadedModel
from nerfdiff.model import NerfDiff
from nerfdiff.results.environment import hardware
from nerfdiff.stability.elevation import framed
from nerfdiff.stability.familiar import Familiar, features
from nerfdiff.stability.judge import Judge
from nerfdiff.stability.mend import mend_of
from nerfdiff.stress.stress import Stress, row_fields, stress_of
from nerfdiff.utils.config import auto_precision, plain
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.hashes import sha256_file, sha256_values
from nerfdiff.utils.shard import Shard
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)

PRECISIONS = {"32-true": None, "bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}
SAMPLES = ("uniform_samples", "importance_samples")
AUTO = "auto"


@dataclass(frozen=True)
class Orbit:
    """Settings of the videos of a circle around the object; `scenes` are shown side by side in evaluate.py's."""

    frames: int
    fps: int
    scenes: int = 1


@dataclass(frozen=True)
class Sheet:
    """Settings of the contact sheet."""

    scenes: int
    views: int


@dataclass(frozen=True)
class RunSettings:
    """Settings that evaluate.py and distill.py share (`conf/common/evaluation.yaml` says more of each).

    Args:
        dataset: name and split.
        results: file to which a row per strategy is appended.
        scoring: settings of the metrics, as plain data.
        compiled: whether the U-Nets are.
        minutes: after which no scene begins.
        progress_every: seconds between lines where there is no terminal.
        per_scene: leave every scene's field, trace and orbit beside its views.
        keep_steps: how many fields from on the way of distillation are left beside each scene's.
        shard: of the scenes, that this run makes; None: all.
        stress, severity, neutral: what goes wrong on purpose, by how much, and how much is nothing; None: nothing.
    """

    run_name: str
    dataset: str
    seed: int
    results: Path
    scoring: Mapping[str, Any]
    compiled: bool
    scenes_at_once: int
    minutes: float | None
    progress_every: float | None
    per_scene: bool
    keep_steps: int
    orbit: Orbit
    sheet: Sheet
    shard: Shard | None
    stress: str | None
    severity: float | None
    neutral: float | None

    @staticmethod
    def of(cfg: DictConfig) -> "RunSettings":
        """Read the settings of a composed config."""
        same = ("run_name", "seed", "scenes_at_once", "minutes", "progress_every", "per_scene", "keep_steps")
        return RunSettings(
            **{name: cfg[name] for name in same},
            dataset=f"{cfg.data.name}/{cfg.data.test_split}",
            results=Path(cfg.results),
            scoring=plain(cfg.metrics),
            compiled=cfg.compile != "none",
            orbit=instantiate(cfg.orbit),
            sheet=instantiate(cfg.sheet),
            shard=Shard.read(cfg.shard),
            **row_fields(stress_of(cfg)),
        )


@dataclass(frozen=True)
class EvaluationRun:
    """A model and scenes, on a device.

    Args:
        load: reads the scenes of these ids, in batches of one.
        scene_ids: of this run's scenes.
        split_ids: of all scenes, of which a shard has a part.
        identity: all settings that predictions depend on.
        folder: holds all files of the run.
        stability: of the model's training, see `LoadedModel`.
        cost_key: a digest of settings that change the costs of scenes, and their numbers by rounding at most: hardware,
            threads, scenes at once, the renderer's chunks and the memory layout.
        rows_before: bytes of the file of results before this run.
        data: where the scenes come from; None for a picture, whose other views nobody knows.
        judge: says of every scene whether its views can be trusted; None: nothing does.
        familiar: what the judge knows of the model's training images; None: nothing.
        stress: of the scenes, whose input `load` gives with it, and of the strategy; None: none.
    """

    settings: RunSettings
    model: NerfDiff
    load: Callable[[Sequence[str]], Iterable[ViewBatch]]
    scene_ids: list[str]
    split_ids: list[str]
    device: torch.device
    precision: str
    identity: dict[str, Any]
    folder: Path
    stability: Mapping[str, float | int | None]
    cost_key: str
    rows_before: int
    data: SceneDataModule | None
    judge: Judge | None
    familiar: Familiar | None
    stress: Stress | None

    @property
    def predictions(self) -> Path:
        return self.folder / "predictions"

    def stressed(self, strategy: Strategy) -> Strategy:
        """Return the strategy with this run's stress, where it acts on virtual views or targets."""
        return strategy if self.stress is None else self.stress.strategy(strategy, self.load, self.split_ids)

    def autocast(self) -> AbstractContextManager:
        return autocast(self.device, self.precision)


def autocast(device: torch.device, precision: str) -> AbstractContextManager:
    """Compute products in halves where the precision asks for it."""
    if (halves := PRECISIONS[precision]) is None:
        return nullcontext()
    # Without the cache: it would keep the first half copy of parameters that a strategy fits.
    return torch.autocast(device.type, halves, cache_enabled=False)


def choose_device(name: str) -> torch.device:
    """Return a device by its name; `auto` is the first GPU, or the CPU where there is none.

    Raises:
        ConfigError: it cannot be used here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter where PyTorch was built without CUDA
        raise ConfigError(
            f"device={name} cannot be used here ({str(error).splitlines()[0]}); try device=auto"
        ) from error
    return device


def _load(cfg: DictConfig) -> LoadedModel:
    """Load the model with the renderer's settings of this run; null leaves those of the training."""
    for name in SAMPLES:
        if cfg[name] is not None and cfg[name] < 1:
            raise ConfigError(f"{name}={cfg[name]} must be at least 1, or null for what the model was trained with")
    renderer = {name: cfg[name] for name in ("backend", "kernel_precision", "skip", "chunk", *SAMPLES)}
    renderer = {name: value for name, value in renderer.items() if value is not None}
    loaded = load_model(cfg.ckpt, cfg.weights, cfg.paths.assets_dir, renderer)
    log.info("ckpt=%s", loaded.describe())
    return loaded


def dataset_run(cfg: DictConfig, device: torch.device) -> EvaluationRun:
    """Prepare the test scenes of `cfg.data`.

    Raises:
        UserError: bad data, config or checkpoint.
    """
    loaded = _load(cfg)
    datamodule = instantiate(cfg.data)
    datamodule.shard = None if (stress := stress_of(cfg)) is not None else Shard.read(cfg.shard)
    datamodule.setup("test")
    reader = datamodule.reader("test")
    split_ids = [reader.scene_id(index) for index in spread(len(reader), datamodule.eval_scenes)]
    if stress is not None:  # which may show a scene another one's images
        stress.inputs(datamodule.test_set)
    position = {reader.scene_id(index): place for place, index in enumerate(datamodule.test_set.indices)}
    scene_ids = split_ids if (shard := Shard.read(cfg.shard)) is None else list(shard.share(split_ids))

    def load(names: Sequence[str]) -> Iterable[ViewBatch]:
        return datamodule.scenes([position[name] for name in names])

    size = list(next(iter(load(scene_ids[:1]))).source.shape[-2:])
    if loaded.image_size is not None and loaded.image_size != size:
        # a model is good at the resolution it was trained at; at another its numbers say little of it
        raise ConfigError(
            f"{loaded.path} was trained on images of {loaded.image_size}, the data gives {size}: "
            f"set data.image_size=[{loaded.image_size[0]},{loaded.image_size[1]}]"
        )
    facts = {
        "split_sha256": sha256_values(split_ids),
        "files_sha256": reader.fingerprint(),
        "reader": reader.identity,
        "views": [cfg.data.source_view, cfg.data.eval_stride],
        "image_size": size,
        "mean_image_scenes": cfg.get("mean_image_scenes"),  # a baseline of evaluate.py
    }
    if shard is not None:
        facts["shard"] = str(shard)
    return _run(cfg, device, loaded, load, scene_ids, split_ids, facts, datamodule, stress)


def picture_run(cfg: DictConfig, device: torch.device) -> EvaluationRun:
    """Prepare the scene of the picture `cfg.image`, to be rendered from `cfg.picture_views`.

    Raises:
        UserError: bad picture, config or checkpoint.
    """
    loaded = _load(cfg)
    size = loaded.image_size or plain(cfg.picture_size)
    if size is None:
        raise ConfigError(f"{loaded.path} does not say what image size it is for: give picture_size=[height,width]")
    if cfg.shard is not None:
        raise ConfigError(f"shard={cfg.shard} is of a dataset's scenes, and image={cfg.image} is one picture")
    if (stress := stress_of(cfg)) is not None and stress.input_view is not None:
        raise ConfigError(f"stress={stress.axis} chooses another input view, and a picture has none")
    framed = framed_as_trained(cfg, loaded)
    scene = picture_scene(framed, loaded, size)
    cfg.picture, cfg.picture_views = framed.picture, framed.picture_views  # what was estimated, for the strategy
    facts = {
        "split_sha256": sha256_values(list(scene.scene_ids)),
        "files_sha256": [sha256_file(file) for file in (cfg.image, cfg.picture.mask) if file],
        "picture": plain(cfg.picture),
        "picture_views": plain(cfg.picture_views),
        "image_size": list(size),
    }
    ids = list(scene.scene_ids)
    return _run(cfg, device, loaded, lambda names: [scene] * len(names), ids, ids, facts, None, stress)


def framed_as_trained(cfg: DictConfig, loaded: LoadedModel) -> DictConfig:
    """Return a config whose picture is framed as the model's training images were, in all that it leaves at `auto`.

    What the model does not say, `cfg.framing` does, and a log line names it.
    """
    cfg = copy.deepcopy(cfg)
    asked = [key for key, value in cfg.picture.items() if value == AUTO]
    if not asked:
        return cfg
    familiar = Familiar.beside(loaded.path)
    known = familiar.framing() if familiar is not None else None
    if known is None:
        known = cfg.framing
        log.warning(
            "%s does not say how its training images were framed (docs/stability.md: part=familiar): picture.%s as "
            "framing has them, which are of SRN's cars",
            loaded.path,
            ", picture.".join(asked),
        )
    for key in asked:
        cfg.picture[key] = known[key]
    return cfg


def picture_scene(
    cfg: DictConfig, loaded: LoadedModel, size: Sequence[int], where: np.ndarray | None = None
) -> ViewBatch:
    """The scene of the picture `cfg.image`, whose targets are the cameras of `cfg.picture_views`, not yet known.

    An elevation of `auto` is estimated by the model, or taken to be `cfg.usual_elevation` where it cannot; `cfg` then
    has the number, and a warning says so.

    Args:
        size: (height, width) of the model's images.
        where: see `Picture.load`.

    Raises:
        UserError: bad picture or config.
    """
    scene = instantiate(cfg.picture).load(cfg.image, tuple(size), where)
    if cfg.picture_views.get("source_elevation") == AUTO:
        cfg.picture_views.source_elevation = _elevation(cfg, loaded, scene)
    cameras = instantiate(cfg.picture_views)(scene)
    blank = scene.source_pixels[:, None].expand(-1, cameras.shape[1], -1, -1, -1)
    names = tuple(f"{view:03d}" for view in range(cameras.shape[1]))
    return replace(scene, target_cameras=cameras, target_pixels=blank, target_views=(names,))


def _elevation(cfg: DictConfig, loaded: LoadedModel, scene: ViewBatch) -> float:
    """Estimate the degrees from which a picture looks down at its object."""
    key = "elevation" if "elevation" in cfg else "picture_views.source_elevation"
    familiar = Familiar.beside(loaded.path)
    fit = None if familiar is None else familiar.elevation
    if fit is None or not fit.useful or familiar.framing() is None:
        log.warning(
            "%s cannot estimate elevations (docs/stability.md: part=familiar): %s is taken to look down from %g "
            "degrees at its object; say %s=… if that is wrong",
            loaded.path,
            cfg.image,
            cfg.usual_elevation,
            key,
        )
        return float(cfg.usual_elevation)
    with torch.no_grad():
        own = next(loaded.model.parameters()).device
        shown = framed(scene, familiar.framing()).to(own)
        found = round(float(fit(features(loaded.model.encode(shown)))[0]), 1)
    log.warning(
        "%s is estimated to look down from %g degrees at its object (of training images 9 of 10 are missed by at most "
        "%.0f); say %s=… if that is wrong",
        cfg.image,
        found,
        fit.most,
        key,
    )
    return found


def _run(
    cfg: DictConfig,
    device: torch.device,
    loaded: LoadedModel,
    load: Callable[[Sequence[str]], Iterable[ViewBatch]],
    scene_ids: list[str],
    split_ids: list[str],
    facts: dict[str, Any],
    data: SceneDataModule | None,
    stress: Stress | None,
) -> EvaluationRun:
    precision = cfg.precision if cfg.precision != "auto" else auto_precision(device.type)
    if precision not in PRECISIONS:
        raise ConfigError(f"precision must be auto, {', '.join(PRECISIONS)}, got {precision!r}")
    familiar = Familiar.beside(loaded.path)
    mend = mend_of(cfg, familiar)
    identity = (
        facts
        | {
            "ckpt_sha256": sha256_file(loaded.path),
            "weights": loaded.weights,
            "seed": cfg.seed,
            "precision": precision,
            "kernel_precision": cfg.kernel_precision,
            "backend": cfg.backend,
            "skip": cfg.skip,
            "compile": cfg.compile,
            "samples": {name: getattr(loaded.model.renderer, name) for name in SAMPLES},
            "device": device.type,  # whose generators draw the noise
            "orbit": cfg.per_scene and cfg.orbit.frames,
            "strategy": plain(cfg.strategy),
        }
        | (stress.identity if stress is not None else {})
        | ({"mend": mend.identity} if mend is not None else {})
        | ({"keep_steps": cfg.keep_steps} if cfg.keep_steps else {})
    )
    if cfg.seconds_per_scene is not None and "seconds" not in cfg.strategy:
        log.warning("seconds_per_scene acts on strategies that fit a field: %s takes its time", cfg.strategy.name)
    folder = Path(cfg.paths.output_dir) / f"{cfg.strategy.name}-{sha256_values(identity)[:8]}"
    model = loaded.model.to(device).requires_grad_(False)
    in_pixels = channels_last(cfg.channels_last, device, cfg.compile != "none")
    if in_pixels:
        model.to(memory_format=torch.channels_last)
    if (halves := PRECISIONS[precision]) is not None:
        cast_products(model.denoiser, halves)
    compile_unets(model, cfg.compile, cfg.paths.compiled_dir)
    spent_on = [hardware(device), cfg.threads, cfg.scenes_at_once, model.renderer.chunk, in_pixels]
    settings = RunSettings.of(cfg)
    load = load if stress is None else stress.on(load)
    return EvaluationRun(
        settings=settings,
        model=model,
        load=load if mend is None else lambda names: map(mend, load(names)),
        scene_ids=scene_ids,
        split_ids=split_ids,
        device=device,
        precision=precision,
        identity=identity,
        folder=folder,
        stability=loaded.stability,
        cost_key=sha256_values(spent_on)[:8],
        rows_before=settings.results.stat().st_size if settings.results.is_file() else 0,
        data=data,
        judge=instantiate(cfg.judge),
        familiar=familiar,
        stress=stress,
    )
