"""Exported models: weights as safetensors, with the settings that rebuild the model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from nerfdiff.inputs import WEIGHTS
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import CheckpointError, ConfigError
from nerfdiff.utils.files import atomic, write_text
from nerfdiff.utils.hashes import sha256_file, sha256_values

CONFIG = "model.yaml"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

Read = tuple[Mapping, dict[str, torch.Tensor], Mapping[str, Any]]
"""Settings and weights of a model, and what else is recorded of it."""


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

    model: NerfDiff = field(repr=False)
    path: Path
    weights: str
    config: Mapping = field(repr=False)
    image_size: list[int] | None
    stability: Mapping[str, float | int | None]
    trained_on: Sequence[Mapping[str, Any]] = field(default=(), repr=False)

    def brief(self) -> str:
        """Say in a few words what the model was trained on."""
        size = f"{self.image_size[0]}x{self.image_size[1]} pixels, " if self.image_size else ""
        last = self.trained_on[-1] if self.trained_on else {"about": "what was not recorded"}
        return f"{size}trained on {last['about'] or last['dataset']}"

    def describe(self) -> str:
        """One line on what the model has seen."""
        phases = [
            f"{phase['images']:,} images for the {phase['part']} of {phase['scenes']} scenes of {phase['dataset']} "
            f"({phase['about']})"
            for phase in self.trained_on
        ]
        size = f", {self.image_size[0]}x{self.image_size[1]} pixels" if self.image_size else ""
        return f"{self.path}{size}: trained on {', then '.join(phases) or 'what was not recorded'}"


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


def read_export(path: Path, weights: str) -> Read:
    try:
        settings = yaml.safe_load(path.with_name(CONFIG).read_text())
        stored, config = settings["weights"], settings["model"]
        image_size, digest = settings["image_size"], settings.pop("sha256", None)
        if not isinstance(config, Mapping) or not isinstance(settings.get("stability", {}), Mapping):
            raise TypeError("expected settings by name as its model")
        if not are_phases(settings.get("trained_on", [])):
            raise TypeError("expected what it was trained on as its trained_on")
        if image_size is not None and not is_size(image_size):
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


def are_phases(value: Any) -> bool:
    """Return true for a list of `NerfDiffModule.trained_on`'s entries."""
    kinds = {"part": str, "images": int, "scenes": int, "dataset": str, "about": str}
    return isinstance(value, list) and all(
        isinstance(phase, Mapping) and all(isinstance(phase.get(key), kind) for key, kind in kinds.items())
        for phase in value
    )


def is_size(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(type(side) is int and side > 0 for side in value)
