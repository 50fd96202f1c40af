"""From a file to a model: Lightning checkpoints and exported weights, always read as plain tensors."""

import logging
import pickle
import re
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from nerfdiff.averages import average_of
from nerfdiff.exported_model import DTYPES, LoadedModel, Read, are_phases, export_model, is_size, read_export
from nerfdiff.field.kinds import TRIPLANE
from nerfdiff.inputs import LAST, PREVIOUS, checkpoints, find_weights
from nerfdiff.model import NerfDiff, build_on_meta
from nerfdiff.utils.errors import CheckpointError, ConfigError

SNAPSHOTS = "snapshots"
DIVERGED, DAMAGED = "diverged.ckpt", "damaged.ckpt"
_PREFIX = "model."

log = logging.getLogger(__name__)


def load_model(
    ckpt: str | Path, weights: str, assets: str | Path | None = None, renderer: Mapping = MappingProxyType({})
) -> LoadedModel:
    """Read a model with the sizes it was trained with.

    Args:
        ckpt, assets: see `find_weights`.
        weights: `ema`, the average that the paper evaluates, or `raw`.
        renderer: settings of the `Renderer` that replace those of the training.

    Raises:
        CheckpointError: no such file, not a checkpoint of this project, or it lacks these weights.
        ConfigError: settings that a `Renderer` cannot have.
    """
    if weights not in ("ema", "raw"):
        raise CheckpointError(f"weights must be ema or raw, got {weights!r}")
    path = find_weights(ckpt, assets)
    if path in checkpoints(ckpt):
        path = last_checkpoint(ckpt)  # the last one that can be read
    read = read_export if path.suffix == ".safetensors" else _read_ckpt
    config, state, about = read(path, weights)
    recorded = about.get("image_size"), about.get("stability") or {}, about.get("trained_on") or ()
    return LoadedModel(_build(config, renderer, state, path), path, weights, config, *recorded)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A Lightning checkpoint as plain data, every byte of it checked.

    Raises:
        CheckpointError: the file is missing, damaged, or no checkpoint of this project; the message says which one
            beside it can be read instead.
    """
    try:
        return _read(Path(path))
    except CheckpointError as error:
        raise CheckpointError(f"{error}. {_instead(Path(path))}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        found = path.stat()
        _check_bytes(path, found.st_mtime_ns, found.st_size)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"checkpoint {path} does not exist") from error
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        what = f"{found[1]}, which could run anything" if found else "something else than tensors and settings"
        raise CheckpointError(f"{path} holds {what}, and was not loaded") from error
    except Exception as error:  # damaged bytes surface as whatever zipfile, pickle or PyTorch trips over
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is not a readable checkpoint ({reason})") from error
    if wrong := _unexpected(checkpoint):
        raise CheckpointError(f"{path} is not a checkpoint of NerfDiffModule: {wrong}")
    return checkpoint


@lru_cache(maxsize=16)
def _check_bytes(path: Path, changed: int, size: int) -> None:
    """Compare all bytes of a checkpoint with their CRCs, once per file: PyTorch does not.

    Raises:
        ValueError: it is damaged, or was packed anew.
        OSError, zipfile.BadZipFile: it cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:  # PyTorch would take compressed bytes for weights
                raise ValueError(f"{entry.filename} in it is compressed, which PyTorch's are not")
        if damaged := archive.testzip():
            raise ValueError(f"bytes of {damaged} in it changed since they were written")


def _unexpected(checkpoint: Any) -> str | None:
    """Name the first part that is not as `NerfDiffModule` saves it; None where all are."""

    def tensors(value: Any) -> bool:
        return isinstance(value, Mapping) and all(isinstance(part, torch.Tensor) for part in value.values())

    if not isinstance(checkpoint, dict):
        return f"it holds a {type(checkpoint).__name__}"
    settings = checkpoint.get("hyper_parameters")
    model = settings.get("model") if isinstance(settings, Mapping) else None
    if not isinstance(model, Mapping) or not all(isinstance(model.get(k), Mapping) for k in ("unet", "field")):
        return "it holds no model settings"
    for key, needed, possible, expected in (
        ("state_dict", True, tensors, "tensors by name"),
        ("current_model_state", False, tensors, "tensors by name"),
        ("global_step", True, lambda value: isinstance(value, int) and value >= 0, "a number of steps"),
        ("image_size", False, lambda value: value is None or is_size(value), "[height, width]"),
        ("stability", False, lambda value: isinstance(value, Mapping), "numbers by name"),
        ("SceneDataModule", False, _is_text_by_name, "what it was trained on"),
        ("trained_on", False, are_phases, "what it was trained on"),
    ):
        if (needed or key in checkpoint) and not possible(checkpoint.get(key)):
            return f"expected {expected} as its {key}, found a {type(checkpoint.get(key)).__name__}"
    return None


def _is_text_by_name(value: Any) -> bool:
    keys = ("root", "reader", "files")
    return isinstance(value, Mapping) and all(isinstance(value.get(key), str) for key in keys)


def _instead(path: Path) -> str:
    """Say what to do where a checkpoint cannot be read: use the one beside it that was trained longest."""
    steps = {}
    for other in path.parent.glob("*.ckpt") if path.parent.is_dir() else ():
        if other.name not in (path.name, DIVERGED, DAMAGED) and other.is_file():
            with suppress(CheckpointError):
                steps[other] = _read(other)["global_step"]
    if not steps:
        return "Give another checkpoint, or delete it to start afresh"
    best = max(steps, key=steps.get)
    return (
        f"{best} beside it can be read, of step {steps[best]}: say ckpt={best}; to train on from there, copy it to "
        f"{path.parent / LAST}"
    )


def export(
    ckpt: str | Path,
    weights: str,
    out: str | Path,
    dtype: str,
    assets: str | Path | None,
    average: float | None = None,
    step: int | None = None,
    shared: str | None = None,
) -> Path:
    """`load_model`, then `export_model`; returns the file.

    Args:
        average: instead of the EMA, the average of this length σ_rel from the run's snapshots (`average_of`).
        step: up to which it goes; None: the last snapshot.

    Raises:
        CheckpointError: see `load_model` and `average_of`.
        ConfigError: `dtype` is not a floating-point type to store weights in.
    """
    if dtype not in DTYPES:
        raise ConfigError(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    loaded = load_model(ckpt, weights, assets)
    if average is not None:
        state = average_of(Path(ckpt) / SNAPSHOTS, average, step)
        if state.keys() != dict(loaded.model.named_parameters()).keys():
            raise CheckpointError(f"the snapshots in {Path(ckpt) / SNAPSHOTS} are of another model than {loaded.path}")
        loaded.model.load_state_dict(state, strict=False)  # buffers are no part of an average
        phases = [*loaded.trained_on[:-1], *({**phase, "average": average} for phase in loaded.trained_on[-1:])]
        loaded = replace(loaded, trained_on=phases)
    return export_model(loaded, out, DTYPES[dtype], shared)


def differences(old: Mapping, new: Mapping, prefix: str = "") -> list[str]:
    """Settings that differ between two nested mappings, as `key: old → new`."""
    found = []
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            found += differences(before, after, f"{prefix}{key}.")
        elif before != after:
            found.append(f"{prefix}{key}: {before} → {after}")
    return found


def check_resumable(path: str | Path, model_config: Mapping, accumulate: int) -> None:
    """Refuse to resume a run whose model or accumulation has other settings.

    Settings that trade memory or the last digits for time (`chunk`, `checkpointing`, `least_transmittance`) may change:
    the model is the same.

    Raises:
        CheckpointError: naming every setting that differs.
    """
    checkpoint = read_checkpoint(path)
    trained = checkpoint["hyper_parameters"]["model"]
    # before fields had names there was one kind of them
    trained = trained | {"field": {"name": TRIPLANE} | trained["field"]}
    trained = trained | {"unet": {"patch": 1} | trained["unet"]}  # likewise before patches
    changed = [
        difference
        for difference in differences(trained, model_config, "model.")
        if not difference.startswith(("model.render.chunk:", "model.unet.checkpointing:", "model.render.least_trans"))
    ]
    before = checkpoint.get("accumulate_grad_batches", accumulate)
    if before != accumulate:  # Lightning counts batches, of which a step would then have another number
        changed.append(f"trainer.accumulate_grad_batches: {before} → {accumulate}")
    if changed:
        raise CheckpointError(
            f"{path} was trained with other settings ({'; '.join(changed)}). Resume with those, or choose another "
            f"run_name to start afresh"
        )


def _read_ckpt(path: Path, weights: str) -> Read:
    checkpoint = read_checkpoint(path)
    averaged = "current_model_state" in checkpoint
    if weights == "ema" and not averaged:
        raise CheckpointError(f"{path} holds no averaged weights (no EMA callback in that run): use weights=raw")
    state = checkpoint["current_model_state" if weights == "raw" and averaged else "state_dict"]
    state = {name.removeprefix(_PREFIX): value for name, value in state.items() if name.startswith(_PREFIX)}
    return checkpoint["hyper_parameters"]["model"], state, checkpoint


def _build(config: Mapping, renderer: Mapping, state: dict[str, torch.Tensor], path: Path) -> NerfDiff:
    try:
        expected = {name: value.shape for name, value in build_on_meta(config).state_dict().items()}
        found = {name: value.shape for name, value in state.items()}
        if wrong := [name for name in expected | found if expected.get(name) != found.get(name)]:
            raise ValueError(
                f"{len(wrong)} weights, as {wrong[0]}: {found.get(wrong[0])}, expected {expected.get(wrong[0])}"
            )
        weights = {name: value.float() for name, value in state.items()}
    except Exception as error:  # settings of any kind surface as whatever a module trips over
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(f"{path} does not fit its own settings: {reason}") from error
    model = NerfDiff(**config | {"render": {**config["render"], **renderer}})
    model.load_state_dict(weights)
    return model.eval()


def last_checkpoint(run: str | Path) -> Path:
    """The checkpoint that a run resumes from: the last one that can be read; a line says if there is a later one.

    Beside `last-v1.ckpt`, which Lightning writes where it is not to replace a file, `last.ckpt` may be an old one: then
    the one of most steps is taken.

    Returns:
        its path, or where the first will be.

    Raises:
        CheckpointError: there are checkpoints, but none that can be read.
    """
    found = [path for path in checkpoints(run) if path.is_file()]
    if any(path.name not in (LAST, PREVIOUS) for path in found):
        found.sort(key=lambda path: steps_of(path) or 0, reverse=True)
        log.info("of %s the one of most steps is taken", ", ".join(path.name for path in found))
    for number, path in enumerate(found):
        if number + 1 == len(found):
            read_checkpoint(path)
            return path
        try:
            _read(path)
            return path
        except CheckpointError as error:
            log.warning("%s; the one before it is taken, %s", error, found[number + 1])
    return checkpoints(run)[0]


def steps_of(path: Path) -> int | None:
    """Return a checkpoint's steps; None where it cannot be read."""
    try:
        return _read(path)["global_step"]
    except CheckpointError:
        return None


def describe(path: Path) -> str:
    """A sentence on the checkpoint that a run resumes from, read to say it."""
    if not path.is_file():
        return "No checkpoint was saved yet."
    return f"Step {read_checkpoint(path)['global_step']} is saved in {path}."


def check_finite(path: Path) -> None:
    """Read all weights of a checkpoint.

    Raises:
        CheckpointError: some are not finite.
    """
    checkpoint = read_checkpoint(path)
    for name, value in (checkpoint["state_dict"] | checkpoint.get("current_model_state", {})).items():
        if value.is_floating_point() and not value.isfinite().all():
            raise CheckpointError(f"{path} holds weights that are not finite ({name})")


def check_same_data(path: Path, now: Mapping[str, str]) -> None:
    """Refuse to go on with other data than a run began with; files that were only moved, or are streamed, are the same.

    Args:
        now: what `SceneDataModule.state_dict` says of the data.

    Raises:
        CheckpointError: naming both roots.
    """
    before = read_checkpoint(path).get("SceneDataModule")
    if before is None:
        log.warning("%s does not say what data it was trained on: whether that was %s is unchecked", path, now["root"])
        return
    if before == now:
        return
    moved = before["reader"].replace(before["root"], now["root"])
    if before["files"] == now["files"] and now["reader"] in (moved, before["reader"]):
        if now["reader"] == moved:
            log.info("the data moved from %s to %s", before["root"], now["root"])
        return
    if before["root"] != now["root"]:
        what = f"data.root={before['root']}, and data.root is {now['root']} now"
    elif before["reader"] != now["reader"]:
        what = f"data.root={now['root']} read as '{before['reader']}', and it is read as '{now['reader']}' now"
    else:
        what = f"data.root={now['root']}, and files there were added, removed or changed since"
    raise CheckpointError(
        f"the run of {path} was trained on {what}. Go on with the data it began with, choose another run_name to "
        "start afresh, or say other_data=true to go on with the other data"
    )
