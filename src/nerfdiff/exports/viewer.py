"""A field as one page that any browser draws, without a network: planes as textures, the decoder in a shader."""

import base64
import json
from html import escape
from pathlib import Path
from string import Template

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import UInt8

from nerfdiff.fit.saved_field import SavedField
from nerfdiff.trajectories import Upright
from nerfdiff.utils.files import write_text

PAGE = Path(__file__).parent / "page" / "viewer.html"
FINER = 2
"""Points looked at along each axis of a cell to tell whether it is empty."""


def write_viewer(path: Path, saved: SavedField, stands: Upright, title: str, cells: int, samples: int) -> Path:
    """Write the page; its shader samples rays evenly, within the ball that `SurfaceSettings` takes of a field.

    Args:
        cells: along each axis of a grid that tells what is empty.
        samples: along each ray while the scene moves; twice as many when it rests.

    Raises:
        DataError: the file cannot be written.
    """
    field = saved.field
    source, decoder = field.cameras.to("cpu"), field.decoder
    near, far = float(field.near[0]), float(field.far[0])
    planes = field.planes.detach().cpu()[0]
    planes = F.pad(planes, (0, 0, 0, 0, 0, -planes.shape[1] % 4)).half()  # channels in groups of four
    _, channels, height, width = planes.shape
    texels = planes.unflatten(1, (-1, 4)).permute(0, 1, 3, 4, 2).contiguous()
    inner, outer = (
        {name: value.detach().cpu().float() for name, value in layer.named_parameters()}
        for layer in (decoder.hidden, decoder.output)
    )
    hidden = len(inner["bias"])
    units = -hidden % 4  # of no weight
    weight = F.pad(inner["weight"], (0, channels - inner["weight"].shape[1], 0, units))
    numbers = [weight, F.pad(inner["bias"], (0, units)), F.pad(outer["weight"], (0, units)).T, outer["bias"]]
    arm = source.centres[0] - stands.point
    K, size = source.K[0], (source.width, source.height)
    scene = {
        "planes": _text(texels.numpy()),
        "plane": [width, height],
        "groups": channels // 4,
        "hidden": hidden + units,
        "decoder": _text(torch.cat([part.flatten() for part in numbers]).numpy()),
        "soft": [decoder.density_shift, decoder.density_scale],
        "filled": _text(_filled(saved, stands, cells)),
        "cells": cells,
        "near": near,
        "far": far,
        "lens": [
            float(K[0, 0]) / size[0],
            float(K[1, 1]) / size[1],
            float(K[0, 2]) / size[0],
            float(K[1, 2]) / size[1],
        ],
        "aspect": size[0] / size[1],
        "radius": (far - near) / 2,
        "middle": stands.point.tolist(),
        "up": stands.up.tolist(),
        "front": stands.axes(source)[2].tolist(),
        "distance": float(arm.norm()),
        "elevation": float(stands.elevation(source)[0]),
        "samples": samples,
    }
    page = Template(PAGE.read_text(encoding="utf-8").replace("${", "$${"))  # JavaScript's own
    words = {"title": escape(title), "aspect": f"{size[0]} / {size[1]}", "scene": json.dumps(scene)}
    write_text(path, page.substitute(words))
    return path


@torch.no_grad()
def _filled(saved: SavedField, stands: Upright, cells: int) -> UInt8[np.ndarray, "z y x"]:
    """Where anything is to be seen in the ball around what cameras look at, or in the cell beside it."""
    field, n = saved.field.field(), cells * FINER
    depth = float(saved.field.far[0] - saved.field.near[0])
    axis = ((torch.arange(n) + 0.5) / n - 0.5) * depth
    volume = torch.zeros(n, n, n)
    for i, z in enumerate(axis):
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        offsets = torch.stack([x, y, z.expand_as(x)], -1)
        within = offsets.norm(dim=-1) < depth / 2
        if within.any():
            points = (offsets[within] + stands.point.cpu()).to(saved.field.K.device)
            volume[i][within] = field(points[None])[1][0].cpu()
    seen = 1 - torch.exp(-volume * depth / cells) > 1 / 512
    largest = F.max_pool3d(seen[None, None].float(), FINER)
    return (F.max_pool3d(largest, 3, 1, padding=1)[0, 0] * 255).byte().numpy()


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
