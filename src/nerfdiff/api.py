"""NerfDiff from Python: a picture to a scene, and what can be made of it.

    import nerfdiff
    model = nerfdiff.load("demo")
    scene = model.distil("car.png")
    scene.orbit("car.mp4")
    scene.save("car.glb")

Nothing is written but what is asked for. The settings are those of `conf/picture.yaml`.
"""

import copy
import logging
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from PIL import Image

from nerfdiff.checkpoint import load_model
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.cutout import Mask
from nerfdiff.distill.kept_steps import KeptSteps
from nerfdiff.distill.priors import all_cameras
from nerfdiff.evaluation.distill import build_strategy
from nerfdiff.evaluation.progress import SceneProgress
from nerfdiff.evaluation.run import autocast, choose_device, framed_as_trained, picture_scene
from nerfdiff.exported_model import LoadedModel
from nerfdiff.exports.export import FieldExport
from nerfdiff.exports.views import render_rgba, to_image
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField, load_field, save_field
from nerfdiff.inputs import FORMATS, check_file, check_picture_settings
from nerfdiff.stability.familiar import Familiar
from nerfdiff.stability.judge import OK
from nerfdiff.stability.mend import mend_of
from nerfdiff.trajectories import Upright
from nerfdiff.utils.config import auto_precision, plain
from nerfdiff.utils.errors import BackgroundError, ConfigError

log = logging.getLogger(__name__)


def load(ckpt: str | Path = "demo", device: str = "auto", weights: str = "ema") -> "Model":
    """Read a trained model.

    Args:
        ckpt: a shipped model's name (`demo`: cars, `demo_chairs`), a run's folder, an exported model's, or a `.ckpt`.
        device: auto, cpu, cuda, cuda:1, …
        weights: `ema` or `raw`.

    Raises:
        CheckpointError, ConfigError: there is no such model, it cannot be read, or the device cannot be used.
    """
    place = choose_device(device)
    loaded = load_model(ckpt, weights)
    loaded.model.to(place).requires_grad_(False)
    return Model(loaded, place)


def load_scene(path: str | Path, device: str = "auto") -> "Scene":
    """Read a scene that `Scene.save` or `distill.py` wrote (`field.safetensors`).

    Raises:
        DataError: there is no such file, or it is none.
    """
    saved = load_field(path)
    return Scene(replace(saved, field=saved.field.to(choose_device(device))))


@dataclass(frozen=True)
class Model:
    """A trained model on a device."""

    loaded: LoadedModel
    device: torch.device

    def __repr__(self) -> str:
        return f"Model({self.loaded.path}: {self.loaded.brief()}; on {self.device})"

    def distil(
        self,
        picture: str | Path,
        *,
        strategy: str = "ngd_current",
        budget: str = "minutes",
        elevation: float | None = None,
        mask: str | Path | None = None,
        box: Sequence[float] | None = None,
        seed: int = 0,
        settings: Sequence[str] = (),
    ) -> "Scene":
        """Make a scene of one picture of an object, in about half a minute on a CPU core with `ckpt=demo`.

        Args:
            picture: file, with a transparent background, or on white, or with a mask; else the object is cut out, which
                a logged warning says (`Scene.mask`).
            strategy: `ngd_current`, `ngd`, `direct`, `sds`, `stochastic` or `none`.
            budget: how much it may compute: `minutes` or `paper`.
            elevation: degrees from which the picture looks down at the object; None: estimated, which a logged
                warning says.
            mask: file of the picture's size, white where the object is.
            box: [left, top, right, bottom] in pixels, in which the object lies.
            seed: of all noise.
            settings: more of `conf/picture.yaml`, as on the command line: `["budget.steps=32"]`.

        Raises:
            DataError: the picture cannot be read, or no object stands out in it.
            ConfigError: arguments or settings that cannot be, or a strategy that leaves no scene.
        """
        for key, file in (("picture", picture), ("mask", mask)):
            if file is not None or key == "picture":
                _check_path(key, file)
        if isinstance(settings, str) or not all(isinstance(word, str) and "=" in word for word in settings):
            raise ConfigError(f'settings={settings!r}: expected a list of key=value, as ["budget.steps=32"]')
        words = [f"ckpt={self.loaded.path}", f"strategy={strategy}", f"budget={budget}", f"seed={seed}"]
        words += [] if elevation is None else [f"elevation={_degrees(elevation)}"]
        words += [] if mask is None else [f"mask={mask}"]
        words += [] if box is None else [f"box={_box(box)}"]
        cfg = load_config("picture", [*words, *settings])
        check_picture_settings(cfg)
        return self.distil_batch(*self.prepare(cfg, picture))

    def prepare(self, cfg: DictConfig, picture: str | Path) -> tuple[DictConfig, ViewBatch, Mask | None]:
        """Frame a picture as this model's training images were, and cut it out where that is needed.

        Args:
            cfg: composed of `conf/picture.yaml`.

        Returns:
            the config of this picture, the picture as a batch, and the mask where one had to be found.

        Raises:
            DataError: see `distil`.
        """
        cfg, size = _of_picture(cfg, picture, self.loaded), self.loaded.image_size or plain(cfg.picture_size)
        if size is None:
            raise ConfigError(f"{self.loaded.path} does not say its image size: give picture_size=[height,width]")
        mask = _cut_out(cfg, picture) if cfg.cutout.box is not None else None
        try:
            scene = picture_scene(cfg, self.loaded, size, mask and mask.where)
        except BackgroundError:
            mask = _cut_out(cfg, picture)
            scene = picture_scene(cfg, self.loaded, size, mask.where)
        if (mend := mend_of(cfg, Familiar.beside(self.loaded.path))) is not None:
            scene = mend(scene)
        return cfg, scene.to(self.device), mask

    def distil_batch(self, cfg: DictConfig, batch: ViewBatch, mask: Mask | None = None) -> "Scene":
        """Make a scene of what `prepare` returned."""
        strategy, precision, kept = build_strategy(cfg), auto_precision(self.device.type), KeptSteps(cfg.keep_steps)
        self.loaded.model.renderer = replace(self.loaded.model.renderer, skip=cfg.skip)
        with SceneProgress(strategy.name, 1, cfg.progress_every) as progress, autocast(self.device, precision):
            callbacks = [*progress.callbacks(1), *([kept] if kept.count else ())]
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated")  # in Lightning
                (views,) = strategy.predict(self.loaded.model, [batch], cfg.seed, callbacks)
            progress.advance("")
        if views.field is None:
            raise ConfigError(f"strategy={strategy.name} leaves no scene: choose one that does, as ngd_current")
        if views.status != "ok":
            log.warning("the fit was %s: this is the last field before that", views.status)
        judge, familiar = instantiate(cfg.judge), Familiar.beside(self.loaded.path)
        with autocast(self.device, precision):
            verdict = judge.verdict(judge.signs(self.loaded.model, batch, views, familiar, cfg.seed), views.status)
        if verdict != OK:
            log.warning("the scene of %s is %s", batch.scene_ids[0], verdict)
        stands = Upright.seen_by(all_cameras(batch)).to("cpu")
        picture = Image.fromarray(batch.source_pixels[0].permute(1, 2, 0).cpu().numpy())
        steps = kept.fields[0] if kept.fields else {}
        return Scene(replace(views.field, stands=stands), picture, mask, views.status, verdict, steps)


def _check_path(key: str, file: object) -> None:
    if not isinstance(file, str | os.PathLike):
        raise ConfigError(
            f"{key}={type(file).__name__}: expected the path of a file; save the image, and give its path"
        )
    check_file(key, os.fspath(file), "name a picture")


def _degrees(elevation: object) -> float:
    try:
        if math.isfinite(degrees := float(elevation)):
            return degrees
    except (TypeError, ValueError):
        pass
    raise ConfigError(f"elevation={elevation!r}: expected degrees above the ground, as 30, or None")


def _box(box: object) -> list[float]:
    try:
        edges = [float(edge) for edge in box]
    except (TypeError, ValueError):
        edges = []
    if len(edges) != 4 or not all(map(math.isfinite, edges)):
        raise ConfigError(f"box={box!r}: expected [left, top, right, bottom] in pixels")
    return edges


def _cut_out(cfg: DictConfig, picture: str | Path) -> Mask:
    """Find the object of a picture whose background is neither transparent nor white, or in a box of it."""
    mask = instantiate(cfg.cutout).find(picture)
    doubts = "".join(f"; {doubt}" for doubt in mask.doubts)
    log.warning(
        "%s: the object was cut out %s%s. Look at the mask; box=[left,top,right,bottom] in pixels, or mask=<image of "
        "its size, white where the object is>, gives a better one",
        picture,
        mask.how,
        doubts,
    )
    return mask


def _of_picture(cfg: DictConfig, picture: str | Path, loaded: LoadedModel) -> DictConfig:
    """The config for one picture: its own framing where nobody set another, its elevation and mask."""
    cfg = copy.deepcopy(cfg)
    cfg.image = str(picture)
    if cfg.mask is not None:
        cfg.picture.mask = cfg.mask
    if cfg.elevation is not None:
        cfg.picture_views.source_elevation = cfg.elevation
    return framed_as_trained(cfg, loaded)


@dataclass(frozen=True)
class Scene:
    """A scene that can be seen from any side.

    Args:
        saved: the field and its renderer.
        picture: as the model saw it; None where the scene was read from a file.
        mask: where the object was found, if that had to be.
        status: `ok`, or why the field is not the one that the fit ended with.
        verdict: `ok`, or `suspect:` and why, by signs that need no truth (`docs/stability.md`); None where the scene
            was read from a file.
        steps: fields from on the way, by how many steps of distillation had been done (`keep_steps`).
    """

    saved: SavedField
    picture: Image.Image | None = None
    mask: Mask | None = None
    status: str = "ok"
    verdict: str | None = None
    steps: Mapping[int, RefinedField] = field(default_factory=dict)

    def __repr__(self) -> str:
        field = self.saved.field
        verdict = "" if self.verdict is None else f"; {self.verdict}"
        return f"Scene({field.cameras.height}x{field.cameras.width} pixels, on {field.K.device}{verdict})"

    def render(self, azimuth: float = 0.0, elevation: float | None = None, height: int | None = None) -> Image.Image:
        """A picture of the scene with a transparent background.

        Args:
            azimuth: degrees around the scene, anticlockwise seen from above; 0 is the input camera's.
            elevation: degrees above the horizon; None: the input camera's.
            height: in pixels; None: the input picture's.
        """
        where = None if elevation is None else torch.tensor([float(elevation)])
        export = self._default
        camera = export.stands.around(export.source, torch.tensor([float(azimuth)]), where)
        camera = camera.to(self.saved.field.K.device)
        return to_image(export.cleared(render_rgba(self.saved, camera, height or camera.height))[0])

    def orbit(self, path: str | Path, frames: int = 48, fps: int = 24, height: int = 256) -> Path:
        """Write a video of a full turn, as `.mp4` or `.gif`.

        Raises:
            ConfigError: another ending.
        """
        if Path(path).suffix not in (".mp4", ".gif"):
            raise ConfigError(f"{path}: a video is called .mp4 or .gif")
        return self._write(path, self._export(f"path.frames={frames}", f"fps={fps}", f"height={height}"))

    def save(self, path: str | Path, *settings: str) -> Path:
        """Write the scene: `.safetensors` for `load_scene` and the commands, or a format of `docs/exports.md`.

        Args:
            settings: of `conf/exports`, as on the command line: `"mesh.resolution=192"`.

        Raises:
            ConfigError: an ending that no format has, or a package that is not installed.
            DataError: the file cannot be written, or the scene is empty.
        """
        if Path(path).suffix == ".safetensors":
            save_field(path, self.saved)
            return Path(path)
        return self._write(path, self._export(*settings) if settings else self._default)

    @cached_property
    def _default(self) -> FieldExport:
        return self._export()

    def _export(self, *settings: str) -> FieldExport:
        return FieldExport.of(self.saved, load_config("export", [f"device={self.saved.field.K.device}", *settings]))

    @staticmethod
    def _write(path: str | Path, export: FieldExport) -> Path:
        path = Path(path)
        kind = path.suffix.removeprefix(".")
        if kind not in FORMATS or kind == "png":
            names = ", ".join(f".{name}" for name in ("safetensors", *FORMATS) if name != "png")
            raise ConfigError(f"{path}: no format is called so; expected one of {names} (a picture: scene.render)")
        (written,) = export.write(path.parent, path.stem, [kind])
        return written
