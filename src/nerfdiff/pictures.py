"""Pictures to scenes, each in a folder of its own, with what a person opens next."""

import json
import logging
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from nerfdiff.api import Model, Scene, load, load_scene
from nerfdiff.cli import command_words
from nerfdiff.data.cutout import Mask, write_mask
from nerfdiff.data.picture import scene_id
from nerfdiff.evaluation.dashboard import show_picture
from nerfdiff.exports.export import FieldExport
from nerfdiff.exports.views import over, render_rgba
from nerfdiff.fit.saved_field import FIELD, STEPS, save_steps
from nerfdiff.results.pictures import contact_sheet
from nerfdiff.stability.judge import OK
from nerfdiff.stopping import Stopped
from nerfdiff.utils.config import plain
from nerfdiff.utils.errors import DataError, UserError
from nerfdiff.utils.files import write_text
from nerfdiff.utils.hashes import sha256_file, sha256_values

SCENE = "scene.json"
AROUND = 8
"""Views of the contact sheet."""

log = logging.getLogger(__name__)


def pictures(cfg: DictConfig) -> list[Path]:
    """Make a folder of every picture `cfg.images`; return the folders.

    A scene that is there, made by the same settings of the same picture, is kept. A picture that cannot be used leaves
    the others alone.

    Raises:
        UserError: settings that cannot be; after all pictures, that some failed.
        Stopped: says how many pictures are complete.
    """
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    model = load(cfg.ckpt, cfg.device, cfg.weights)
    log.info("ckpt=%s: %s", cfg.ckpt, model.loaded.brief())
    log.debug("ckpt=%s", model.loaded.describe())
    made, failed = [], []
    for image, folder in zip(cfg.images, folders(cfg.images, Path(cfg.out)), strict=True):
        try:
            _make(cfg, model, Path(image), folder)
            made.append(folder)
        except UserError as error:
            if len(cfg.images) == 1:
                raise
            failed.append(image)
            log.error("%s", error)
        except Stopped as stopped:
            done = f"{len(made)} of {len(cfg.images)} pictures are complete; a scene in the making begins anew."
            raise Stopped(stopped.signum, done) from None
    if failed:
        raise DataError(f"{len(failed)} of {len(cfg.images)} pictures failed, see above")
    return made


def folders(images: Sequence[str], out: Path) -> list[Path]:
    """A folder for each picture, called after its file; of files with one name the later ones have a number."""
    found: list[Path] = []
    for image in images:
        name = number = scene_id(Path(image))
        count = 1
        while out / number in found:
            count += 1
            number = f"{name}_{count}"
        found.append(out / number)
    return found


def _make(cfg: DictConfig, model: Model, image: Path, folder: Path) -> None:
    cfg, batch, mask = model.prepare(cfg, image)
    if mask is not None:
        write_mask(mask, image, folder / "mask.png", folder / "cutout.png")
        log.info("%s: the mask is %s, shown in %s", image, folder / "mask.png", folder / "cutout.png")
    identity = _identity(cfg, model, image, mask)
    scene = _kept(folder, identity, model)
    if scene is None:
        scene = model.distil_batch(cfg, batch, mask)
        shutil.rmtree(folder / STEPS, ignore_errors=True)  # of an earlier scene
        scene.save(folder / FIELD)
        save_steps(folder, scene.saved, scene.steps)
        facts = {"picture": str(image), "identity": identity, "status": scene.status, "verdict": scene.verdict}
        write_text(folder / SCENE, json.dumps(facts) + "\n")
    else:
        log.info("%s: the scene is there already, in %s", image, folder / FIELD)
    written = [_views(scene, batch.source[0].cpu(), folder / "views.png")]
    facts = {"picture": str(image), "status": scene.status, "verdict": scene.verdict, "folder": str(folder)}
    show_picture(cfg, Path(cfg.out), folder.name, facts, written[0])
    export = FieldExport.of(scene.saved, cfg)
    for kind in cfg.format:
        name = {"mp4": "orbit", "gif": "orbit", "html": "viewer"}.get(kind, folder.name)
        written += export.write(folder, name, [kind])
    print(*written, sep="\n")
    if scene.verdict != OK:
        print(f"{scene.verdict} (docs/pictures.md#suspect-scenes)")
    more = " ".join([*command_words("export"), f"field={folder / FIELD}", "format=gif,png"])
    print(f"next: look at {written[0]}; for other files: {more}")


def _identity(cfg: DictConfig, model: Model, image: Path, mask: Mask | None) -> str:
    """A digest of all that a scene depends on."""
    files = [sha256_file(file) for file in (image, model.loaded.path, cfg.picture.mask) if file is not None]
    found = None if mask is None else mask.where.tobytes().hex()
    settings = [cfg.mend_input, *(plain(cfg[key]) for key in ("strategy", "picture", "picture_views", "mend"))]
    steps = [cfg.keep_steps] if cfg.keep_steps else []
    return sha256_values([files, found, settings, cfg.seed, str(model.device), *steps])


def _kept(folder: Path, identity: str, model: Model) -> Scene | None:
    """The scene that is there, if it is the one that would be made."""
    with suppress(OSError, ValueError, KeyError, UserError):  # of another version, or damaged
        facts = json.loads((folder / SCENE).read_text())
        if facts["identity"] == identity:
            scene = load_scene(folder / FIELD, str(model.device))
            return replace(scene, status=facts["status"], verdict=facts["verdict"])
    return None


def _views(scene: Scene, source: torch.Tensor, path: Path) -> Path:
    """The picture, and the scene from all around, in two rows."""
    field, stands = scene.saved.field, scene.saved.stands
    azimuth = torch.arange(AROUND) * (360 / AROUND)
    cameras = stands.around(field.cameras.to("cpu"), azimuth, None).to(field.K.device)
    shown = over(render_rgba(scene.saved, cameras, cameras.height), 1.0)
    half = AROUND // 2
    columns = {f"+ {angle:.0f}°": shown[n::half] for n, angle in enumerate(azimuth[:half].tolist())}
    picture = torch.stack([source, torch.ones_like(source)])
    return contact_sheet(path, {"picture": picture} | columns, ["0°", "180°"], min_cell=256)
