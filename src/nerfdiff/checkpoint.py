"""From a file to a model: Lightning checkpoints and exported weights, always read as plain tensors."""

import logging
import pickle
import re
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from nerfdiff.averages import average_of
from nerfdiff.field.kinds import TRIPLANE
from nerfdiff.inputs import LAST, PREVIOUS, WEIGHTS, find_weights
from nerfdiff.model import NerfDiff, build_on_meta
from nerfdiff.utils.errors import CheckpointError, ConfigError
from nerfdiff.utils.files import atomic, write_text
from nerfdiff.utils.hashes import sha256_file, sha256_values

CONFIG, SNAPSHOTS = "model.yaml", "snapshots"
DIVERGED, DAMAGED = "diverged.ckpt", "damaged.ckpt"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
_PREFIX = "model."

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedModel:
    """A model ready to use, and where it came from.

    Args:
        model: on the CPU, in evaluation mode.
        path: the file its weights were read from.
        weights: `ema` or `raw`.
        config: arguments of `NerfDiff`.
        image_size: (height, width) of the images it was trained on, if known.
        stability: of its training, under the names of `ResultRow`, where that was recorded.
        trained_on: one entry for each training that led to it (`NerfDiffModule.trained_on`), where that was recorded.
    """

    model: NerfDiff
    path: Path
    weights: str
    config: Mapping
    image_size: list[int] | None
    stability: Mapping[str, float | int | None]
    trained_on: Sequence[Mapping[str, Any]] = ()

    def describe(self) -> str:
        """One line on what the model has seen."""
        phases = [
            f"{phase['images']:,} images for the {phase['part']} of {phase['scenes']} scenes of {phase['dataset']} "
            f"({phase['about']})"
            for phase in self.trained_on
        ]
        size = f", {self.image_size[0]}x{self.image_size[1]} pixels" if self.image_size else ""
        return f"{self.path}{size}: trained on {', then '.join(phases) or 'what was not recorded'}"


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
    if Path(ckpt).is_dir() and path.name in (LAST, PREVIOUS):
        path = last_checkpoint(ckpt)  # the last one that can be read
    read = _read_export if path.suffix == ".safetensors" else _read_ckpt
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
        ("image_size", False, lambda value: value is None or _is_size(value), "[height, width]"),
        ("stability", False, lambda value: isinstance(value, Mapping), "numbers by name"),
        ("SceneDataModule", False, _is_text_by_name, "what it was trained on"),
        ("trained_on", False, _are_phases, "what it was trained on"),
    ):
        if (needed or key in checkpoint) and not possible(checkpoint.get(key)):
            return f"expected {expected} as its {key}, found a {type(checkpoint.get(key)).__name__}"
    return None


def _are_phases(value: Any) -> bool:
    """Return true for a list of `NerfDiffModule.trained_on`'s entries."""
    kinds = {"part": str, "images": int, "scenes": int, "dataset": str, "about": str}
    return isinstance(value, list) and all(
        isinstance(phase, Mapping) and all(isinstance(phase.get(key), kind) for key, kind in kinds.items())
        for phase in value
    )


def _is_size(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(type(side) is int and side > 0 for side in value)


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


def export_model(loaded: LoadedModel, folder: str | Path, dtype: torch.dtype, shared: str | Path | None = None) -> Path:
    """Write weights (safetensors) and the settings (YAML) that rebuild the model.

    Args:
        dtype: of the stored weights.
        shared: an exported model's folder beside this one. Weights that are the same there are not written again, and
            are read from there; it has to stay beside this one.

    Raises:
        CheckpointError: weights are not finite, or beyond what `dtype` holds; nothing is written.
        ConfigError: `shared` is elsewhere, or shares nothing.
    """
    folder = Path(folder)
    state = {name: value.to("cpu", dtype).contiguous() for name, value in loaded.model.state_dict().items()}
    for name, value in loaded.model.state_dict().items():
        if not value.isfinite().all():
            raise CheckpointError(
                f"{loaded.path} holds weights that are not finite ({name}), and is not exported: its training "
                "diverged. Give an earlier checkpoint"
            )
        if not state[name].isfinite().all():
            raise CheckpointError(
                f"{loaded.path} holds weights of {value.abs().max():.3g} ({name}), and {dtype} only holds "
                f"{torch.finfo(dtype).max:.3g}: choose dtype=bfloat16 or float32"
            )
    settings = {"weights": loaded.weights, "image_size": loaded.image_size, "model": dict(loaded.config)}
    if shared is not None:
        other = Path(shared) / WEIGHTS
        if folder.absolute().parent != other.absolute().parents[1]:
            raise ConfigError(f"shared={shared}: only a model in the folder that {folder} is in can be shared")
        theirs = _load_weights(other)
        own = {n: v for n, v in state.items() if n not in theirs or not torch.equal(v, theirs[n].to(v.dtype))}
        if len(own) == len(state):
            raise ConfigError(f"shared={shared} has none of the weights of {loaded.path}")
        state = own
        settings["shared"] = {"folder": Path(shared).absolute().name, "sha256": sha256_file(other)}
    with atomic(folder / WEIGHTS) as temporary:
        save_file(state, temporary)
    settings |= {"stability": dict(loaded.stability)} if loaded.stability else {}
    settings |= {"trained_on": [dict(phase) for phase in loaded.trained_on]} if loaded.trained_on else {}
    settings["sha256"] = _digest(folder / WEIGHTS, settings)
    write_text(folder / CONFIG, yaml.safe_dump(settings, sort_keys=False))
    return folder / WEIGHTS


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


Read = tuple[Mapping, dict[str, torch.Tensor], Mapping[str, Any]]
"""Settings and weights of a model, and what else is recorded of it."""


def _read_ckpt(path: Path, weights: str) -> Read:
    checkpoint = read_checkpoint(path)
    averaged = "current_model_state" in checkpoint
    if weights == "ema" and not averaged:
        raise CheckpointError(f"{path} holds no averaged weights (no EMA callback in that run): use weights=raw")
    state = checkpoint["current_model_state" if weights == "raw" and averaged else "state_dict"]
    state = {name.removeprefix(_PREFIX): value for name, value in state.items() if name.startswith(_PREFIX)}
    return checkpoint["hyper_parameters"]["model"], state, checkpoint


def _read_export(path: Path, weights: str) -> Read:
    try:
        settings = yaml.safe_load(path.with_name(CONFIG).read_text())
        stored, config = settings["weights"], settings["model"]
        image_size, digest = settings["image_size"], settings.pop("sha256", None)
        if not isinstance(config, Mapping) or not isinstance(settings.get("stability", {}), Mapping):
            raise TypeError("expected settings by name as its model")
        if not _are_phases(settings.get("trained_on", [])):
            raise TypeError("expected what it was trained on as its trained_on")
        if image_size is not None and not _is_size(image_size):
            raise TypeError(f"expected [height, width] as its image_size, found {image_size!r}")
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"{path.with_name(CONFIG)} cannot be read ({error!r}); it holds the sizes that {path.name} was trained with"
        ) from error
    if weights != stored:
        raise CheckpointError(f"{path} holds {stored} weights only: use weights={stored}")
    state = _load_weights(path)
    if digest is not None and digest != _digest(path, settings):  # exports from before have none
        raise CheckpointError(
            f"{path} and {path.with_name(CONFIG)} are not as they were written together (their SHA-256 is another): "
            "one of the two was damaged, edited or exchanged. Export or copy both anew"
        )
    if shared := settings.get("shared"):
        state = _shared_weights(path, shared) | state
    return config, state, settings


def _load_weights(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is not a readable safetensors file ({error})") from error


def _shared_weights(path: Path, shared: Any) -> dict[str, torch.Tensor]:
    """Return the weights of the model beside this one that it was exported with."""
    kinds = {"folder": str, "sha256": str}
    if not isinstance(shared, Mapping) or not all(isinstance(shared.get(key), kind) for key, kind in kinds.items()):
        raise CheckpointError(f"{path.with_name(CONFIG)}: expected a folder and its sha256 as its shared")
    other = path.parents[1] / Path(shared["folder"]).name / WEIGHTS
    if not other.is_file() or sha256_file(other) != shared["sha256"]:
        raise CheckpointError(
            f"{path} needs the weights of {other}, with which it was exported, and these "
            f"{'are others' if other.is_file() else 'are not there'}: copy both folders together"
        )
    return _load_weights(other)


def _digest(weights: Path, settings: Mapping) -> str:
    return sha256_values([sha256_file(weights), settings])


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

    Returns:
        its path, or where the first will be.

    Raises:
        CheckpointError: there are checkpoints, but none that can be read.
    """
    folder = Path(run) / "checkpoints"
    found = [path for path in (folder / LAST, folder / PREVIOUS) if path.is_file()]
    for number, path in enumerate(found):
        if number + 1 == len(found):
            read_checkpoint(path)
            return path
        try:
            _read(path)
            return path
        except CheckpointError as error:
            log.warning("%s; the one before it is taken, %s", error, found[number + 1])
    return folder / LAST


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
    """Refuse to go on with other data than a run began with; files that were only moved are the same.

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
    if before["files"] == now["files"] and moved == now["reader"]:
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
