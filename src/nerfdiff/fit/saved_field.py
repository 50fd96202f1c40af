"""A refined field on disk: safetensors, with its input camera and all else that rendering needs."""

import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from nerfdiff.cameras import Cameras
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.compact_planes import compact, restored
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.inputs import check_file
from nerfdiff.render.renderer import Renderer
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic

FIELD = "field.safetensors"
STEPS = "steps"
"""Folder beside a field: fields from on the way to it, called after how many steps of distillation had been done."""
FORMAT = 2
"""1 had planes in float32 alone."""
MACHINES = ("backend", "kernel_precision", "skip")
"""Settings of the renderer that suit a machine, not a field."""


@dataclass(frozen=True)
class SavedField:
    """A field and the renderer it was fitted with.

    Args:
        field: on the CPU, of one scene.
        renderer: its samples per ray, background and chunk.
        stands: how the scene stands, where its cameras told.
    """

    field: RefinedField
    renderer: Renderer
    stands: Upright | None = None


def save_field(path: str | Path, saved: SavedField) -> None:
    """Write planes as small as `compact` makes them, the decoder as float32, and the rest as JSON in the header.

    Raises:
        DataError: the file cannot be written.
    """
    field = saved.field
    header = {
        "format": FORMAT,
        "camera": {"K": field.cameras.K[0].tolist(), "height": field.cameras.height, "width": field.cameras.width},
        "planes": list(field.planes.shape),
        "near": float(field.near),
        "far": float(field.far),
        "decoder": field.decoder.settings,
        "render": {name: value for name, value in asdict(saved.renderer).items() if name not in MACHINES},
    }
    if saved.stands is not None:
        header["stands"] = {"point": saved.stands.point.tolist(), "up": saved.stands.up.tolist()}
    decoder = {name: value for name, value in field.state_dict().items() if name != "planes"}
    state = decoder | compact(field, saved.renderer, saved.stands)
    state = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    header["sha256"] = _digest(state)
    with atomic(Path(path)) as temporary:
        save_file(state, temporary, {"nerfdiff": json.dumps(header)})


def load_field(path: str | Path) -> SavedField:
    """Read what `save_field` wrote; needs no checkpoint.

    Raises:
        DataError: the file is missing, damaged, or something else.
    """
    check_file("field", str(path), f"name a {FIELD}")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["nerfdiff"])
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no mapping
        if header["format"] not in range(1, FORMAT + 1):
            raise DataError(f"{path}: format {header['format']!r}, expected at most {FORMAT}; update this project")
        if header.get("sha256", digest := _digest(state)) != digest:  # fields from before have none
            raise DataError(f"{path}: its bytes changed since it was written; copy it anew, or distil the scene again")
        camera = header["camera"]
        cameras = Cameras(torch.eye(4)[None], torch.tensor([camera["K"]]), camera["height"], camera["width"])
        bounds = (torch.tensor([header[name]]) for name in ("near", "far"))
        planes = restored(state, header.get("planes", ()))  # which old files have as they are
        field = RefinedField(Triplane(planes, cameras, *bounds), Decoder(**header["decoder"]))
        field.decoder.load_state_dict(
            {name.removeprefix("decoder."): value for name, value in state.items() if name.startswith("decoder.")}
        )
        stands = header.get("stands")
        stands = stands and Upright(torch.tensor(stands["point"]), torch.tensor(stands["up"]))
        return SavedField(field, Renderer(**header["render"]), stands)
    except DataError:
        raise
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError, zlib.error) as error:
        raise DataError(
            f"{path}: not a field saved by this project ({type(error).__name__}: {error}); distil the scene again"
        ) from error


def save_steps(folder: Path, saved: SavedField, fields: Mapping[int, RefinedField]) -> None:
    """Write fields from on the way to `saved`, by how many steps had been done, into a field's folder."""
    for done, field in fields.items():
        save_field(folder / STEPS / f"{done:04d}.safetensors", replace(saved, field=field))


def load_steps(path: str | Path) -> dict[int, SavedField]:
    """Read the fields that lie beside a field, by how many steps of distillation had been done.

    Raises:
        DataError: one of them cannot be read.
    """
    files = sorted((Path(path).parent / STEPS).glob("*.safetensors")) if Path(path).name == FIELD else []
    return {int(file.stem): load_field(file) for file in files if file.stem.isdigit()}


def _digest(state: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(state[name].numpy())
    return digest.hexdigest()
