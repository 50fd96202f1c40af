"""Predicted views on disk: saved first and scored after, by a scorer that needs no model.

    <root>/<strategy>/plan.json               what is predicted (identity) and for which scenes
    <root>/<strategy>/<scene>/scene.json      views, source views, cost; there only if the scene is complete
                              rgb/<view>.png  8 bit, rounded
                              depth/<view>.npz  depth along z and opacity, float32, where a strategy has them
                              field.safetensors, trace.csv, trace.png, orbit.mp4, where they are asked for

A scene's folder appears under its name only when it is complete, so an interrupted evaluation goes on with
the next scene.
"""

import fcntl
import glob
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from nerfdiff.metrics.image import quantise
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import encode, publish, remove_leftovers, write_text

FORMAT = 2
PLAN = "plan.json"
SCENE = "scene.json"
AGAIN = "delete the folder of its scene and evaluate again"


class NonFinitePrediction(DataError):
    """A model predicted NaN or infinity; saved as 8 bit it would pass for a colour."""


@dataclass(frozen=True)
class Prediction:
    """The predicted views of one scene, as read back.

    Args:
        views: names of the predicted views, in the order of `pixels`.
        source_views: names of the views the model was given.
        cost: what the writer measured (seconds, counts).
        status: `ok`, or why the method fell back to something else.
        verdict: of the judge; None where it did not look.
    """

    scene_id: str
    views: tuple[str, ...]
    source_views: tuple[str, ...]
    pixels: UInt8[Tensor, "views 3 h w"]
    depth: Float[Tensor, "views h w"] | None
    opacity: Float[Tensor, "views h w"] | None
    cost: dict[str, Any]
    status: str
    verdict: str | None


class PredictionWriter:
    """Writes the predictions of one strategy, and knows which scenes are still to do.

    Args:
        root: folder of all strategies.
        strategy: name of the subfolder.
        scenes: ids of all scenes to predict.
        identity: what makes predictions comparable (hashes of config, checkpoint and split, seed, …), as JSON
            values. A folder begun under another identity is refused: two models would be averaged into one.

    Raises:
        DataError: the folder holds predictions of another identity or of other scenes, or cannot be written.
    """

    def __init__(self, root: str | Path, strategy: str, scenes: Sequence[str], identity: Mapping[str, Any]):
        self.folder = Path(root) / _name(strategy)
        self.scenes = tuple(_name(scene) for scene in scenes)
        self._numbers = {scene: number for number, scene in enumerate(self.scenes)}
        self._claims: IO[bytes] | None = None
        plan = {"format": FORMAT, "identity": json.loads(json.dumps(identity)), "scenes": list(self.scenes)}
        if (self.folder / PLAN).exists() and not self._is_lost():
            self._check(plan)
        else:
            write_text(self.folder / PLAN, json.dumps(plan, indent=1) + "\n")

    def _is_lost(self) -> bool:
        """Return true if a power cut left nothing of the plan, and nothing was made by it."""
        return not (self.folder / PLAN).stat().st_size and not any(self.folder.glob(f"*/{SCENE}"))

    def _check(self, plan: dict[str, Any]) -> None:
        found = read_plan(self.folder)
        before, now = found["identity"], plan["identity"]
        differing = [
            f"{key}: {before.get(key)!r} there, {now.get(key)!r} now"
            for key in sorted(before.keys() | now.keys())
            if before.get(key) != now.get(key)
        ]
        if found["scenes"] != plan["scenes"]:
            differing.append(f"{len(found['scenes'])} scenes there, {len(plan['scenes'])} other ones now")
        if differing:
            raise DataError(
                f"{self.folder} holds predictions of another run ({'; '.join(differing)}); "
                "choose another folder, or delete it"
            )

    def pending(self) -> tuple[str, ...]:
        """Scenes not yet complete, in order."""
        return tuple(scene for scene in self.scenes if not (self.folder / scene / SCENE).exists())

    def claim(self, scene: str, wait: bool = False) -> bool:
        """Claim a scene for this process until it is released; false if another makes it, or it is complete.

        Args:
            wait: for another process to complete the scene, or to die over it.
        """
        if self._claims is None:
            self._claims = open(self.folder / ".claims", "a+b")  # noqa: SIM115  (closing it releases all)
        try:
            # of each scene one byte, which may lie beyond the file's end
            fcntl.lockf(self._claims, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, self._numbers[scene])
        except (BlockingIOError, PermissionError):  # what a lock that another holds is, by POSIX
            return False
        if not (self.folder / scene / SCENE).exists():
            remove_leftovers(self.folder, f"{glob.escape(scene)}.*")
            return True
        self.release(scene)
        return False

    def release(self, scene: str) -> None:
        """Let other processes make a scene that was claimed."""
        fcntl.lockf(self._claims, fcntl.LOCK_UN, 1, self._numbers[scene])

    def write(
        self,
        scene_id: str,
        views: Sequence[str],
        images: Float[Tensor, "views 3 h w"],
        source_views: Sequence[str] = (),
        depth: Float[Tensor, "views h w"] | None = None,
        opacity: Float[Tensor, "views h w"] | None = None,
        cost: Mapping[str, Any] | None = None,
        status: str = "ok",
        verdict: str | None = None,
        signs: Mapping[str, float] | None = None,
        beside: Callable[[Path], object] | None = None,
    ) -> Path:
        """Save one scene, whole or not at all.

        Args:
            images: colours, clamped to [0, 1] and rounded to 8 bit here.
            depth: along z in scene units (see `depth.z_depth`); needs `opacity`.
            cost: seconds, counts and conditions of this scene, so that a resumed evaluation still knows them.
            status: `ok`, or why the method fell back to something else.
            verdict, signs: of the judge.
            beside: writes further files into the scene's folder, which appears only when they are there too.

        Raises:
            NonFinitePrediction: an image has NaN or infinite values.
            DataError: the scene is not in the plan, or cannot be written.
        """
        if scene_id not in self._numbers:
            raise DataError(f"scene {scene_id!r} is not one of the scenes of {self.folder / PLAN}")
        if len(views) != len(images) or (depth is None) != (opacity is None):
            raise ValueError(f"{len(views)} names for {len(images)} images; depth and opacity come together")
        if bad := [name for name, image in zip(views, images, strict=True) if not image.isfinite().all()]:
            raise NonFinitePrediction(
                f"scene {scene_id}: {len(bad)} of {len(views)} predicted views are not finite, "
                f"first {bad[0]}; the scene was not saved"
            )
        facts = {
            "format": FORMAT,
            "views": [_name(view) for view in views],
            "source_views": list(source_views),
            "depth": depth is not None,
            "cost": dict(cost or {}),
            "status": status,
            "verdict": verdict,
            "signs": None if signs is None else encode(dict(signs)),
        }
        final, partial = self.folder / scene_id, self.folder / f".{scene_id}.{os.getpid()}.tmp"
        try:
            shutil.rmtree(partial, ignore_errors=True)
            (partial / "rgb").mkdir(parents=True)
            for view, image in zip(views, quantise(images).permute(0, 2, 3, 1).cpu().numpy(), strict=True):
                Image.fromarray(image).save(partial / "rgb" / f"{view}.png")
            if depth is not None and opacity is not None:
                (partial / "depth").mkdir()
                for view, d, o in zip(views, depth.float().cpu(), opacity.float().cpu(), strict=True):
                    np.savez_compressed(partial / "depth" / f"{view}.npz", depth=d.numpy(), opacity=o.numpy())
            if beside is not None:
                beside(partial)
            (partial / SCENE).write_text(json.dumps(facts, indent=1) + "\n")
            if final.exists():
                shutil.rmtree(final)
            publish(partial, final)
        except OSError as error:
            raise DataError(
                f"cannot write predictions to {final}: {error.strerror or error}; scenes before it are kept"
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        return final


def read_plan(folder: Path) -> dict[str, Any]:
    """`plan.json` of one strategy: format, identity, scenes.

    Raises:
        DataError: it is missing, damaged or of another format.
    """
    plan = _read_json(Path(folder) / PLAN)
    if not isinstance(plan.get("scenes"), list) or not isinstance(plan.get("identity"), dict):
        raise DataError(f"{Path(folder) / PLAN}: expected the keys scenes (list) and identity (object)")
    return plan


def read_prediction(folder: Path, scene_id: str) -> Prediction:
    """Read one scene of one strategy.

    Raises:
        DataError: the scene is incomplete or a file is missing or damaged; the message names it.
    """
    scene = Path(folder) / scene_id
    facts = _read_json(scene / SCENE)
    views = tuple(facts["views"])
    pixels = torch.stack([_read_png(scene / "rgb" / f"{view}.png") for view in views])
    depth = opacity = None
    if facts["depth"]:
        arrays = [_read_npz(scene / "depth" / f"{view}.npz") for view in views]
        depth, opacity = (torch.stack(values) for values in zip(*arrays, strict=True))
    return Prediction(
        scene_id,
        views,
        tuple(facts["source_views"]),
        pixels,
        depth,
        opacity,
        facts["cost"],
        facts["status"],
        facts.get("verdict"),  # not in scenes from before there was a judge
    )


def _name(text: str) -> str:
    """`text` if it can be the name of a file."""
    if not text or text.startswith(".") or "/" in text or "\\" in text or "\0" in text:
        raise DataError(f"{text!r} cannot name a file: names of scenes, views and strategies must be plain")
    return text


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{path}: not found; expected predictions written by evaluate.py") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({error}); delete its folder and evaluate again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else content
        raise DataError(f"{path}: format {found!r}, expected {FORMAT}; delete its folder and evaluate again")
    return content


def _read_png(path: Path) -> UInt8[Tensor, "3 h w"]:
    try:
        with Image.open(path) as image:
            pixels = np.array(image)
    except (OSError, SyntaxError) as error:
        raise DataError(f"{path}: cannot be read ({error}); {AGAIN}") from error
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise DataError(f"{path}: {pixels.dtype} of shape {pixels.shape}, expected an 8-bit RGB image")
    return torch.from_numpy(pixels).permute(2, 0, 1)


def _read_npz(path: Path) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return torch.from_numpy(arrays["depth"]), torch.from_numpy(arrays["opacity"])
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DataError(f"{path}: cannot be read ({error}); {AGAIN}") from error
