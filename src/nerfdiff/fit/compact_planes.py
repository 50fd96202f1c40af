"""Planes in few bytes: whole numbers of steps per channel, as coarse as renderings allow, and deflated."""

import copy
import zlib
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.render.renderer import Renderer
from nerfdiff.trajectories import Upright

BITS = (12, 16)
"""Bits per value that are tried, fewest first. With fewer, importance samples jump in views that were not checked."""
BOUND = 0.5 / 255
"""What no colour of the checked views may move by: half of what is promised of all views."""
AZIMUTHS, ELEVATION, SIDE = (0.0, 72.0, 144.0, 216.0, 288.0), 20.0, 48
"""Of the checked views: degrees around the scene, the elevation where none is known, and pixels of a side at most."""


def compact(field: RefinedField, renderer: Renderer, stands: Upright | None) -> dict[str, Tensor]:
    """Return tensors that stand for the planes of a field of one scene.

    Views around the scene are rendered from them and from the planes. The fewest bits are taken with which no colour
    of these moves by more than `BOUND`; where none are enough, the planes stay as they are.
    """
    planes = field.planes.detach()
    if field.finite().all():
        other = copy.deepcopy(field)
        full = _rendered(field, renderer, stands)
        for bits in BITS:
            state = _deflated(planes.cpu(), bits)
            other.planes = nn.Parameter(restored(state, planes.shape).to(planes))
            if (_rendered(other, renderer, stands) - full).abs().max() <= BOUND:
                return state
    return {"planes": planes.cpu()}


def restored(state: Mapping[str, Tensor], shape: Sequence[int]) -> Float[Tensor, "batch 3 channels height width"]:
    """Return the planes that `compact` made tensors of.

    Raises:
        ValueError: they are of another shape.
        zlib.error: the bytes are damaged.
    """
    if "planes" in state:
        return state["planes"]
    low_high = np.frombuffer(zlib.decompress(state["planes.deflated"].numpy().tobytes()), np.uint8).reshape(2, -1)
    steps = low_high[0] + 256.0 * low_high[1]
    return state["planes.least"] + state["planes.step"] * torch.from_numpy(steps).float().reshape(tuple(shape))


def _deflated(planes: Float[Tensor, "batch 3 channels height width"], bits: int) -> dict[str, Tensor]:
    """Count each channel of each plane in steps from its least value; low bytes first, then high ones, deflated."""
    least, most = planes.amin((-1, -2), keepdim=True), planes.amax((-1, -2), keepdim=True)
    step = ((most - least) / (2**bits - 1)).clamp_min(torch.finfo(planes.dtype).tiny)
    steps = ((planes - least) / step).round().to(torch.int32).numpy().ravel()
    low_high = np.stack([steps & 255, steps >> 8]).astype(np.uint8)
    deflated = np.frombuffer(zlib.compress(low_high.tobytes(), 9), np.uint8).copy()
    return {"planes.deflated": torch.from_numpy(deflated), "planes.least": least, "planes.step": step}


@torch.no_grad()
def _rendered(field: RefinedField, renderer: Renderer, stands: Upright | None) -> Tensor:
    """Render views around the scene, in few pixels."""
    source = field.cameras
    middle = float(field.near[0] + field.far[0]) / 2
    stands = (stands or Upright.assumed(middle, ELEVATION)).to(source.K.device)
    scale = min(1.0, SIDE / max(source.height, source.width))
    cameras = stands.around(source, torch.tensor(AZIMUTHS, device=source.K.device), None)
    cameras = cameras.resized(*(max(1, round(scale * side)) for side in (source.height, source.width)))
    return field.render(renderer, cameras[None]).images
