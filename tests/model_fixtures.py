"""Small models and cameras for tests."""

import copy

import torch

from nerfdiff.cameras import Cameras
from nerfdiff.model import NerfDiff

CONFIG = {
    "name": "test",
    "unet": {
        "width": 32,
        "channel_mult": [1, 2],
        "res_blocks": 1,
        "attention_downsampling": [2],
        "head_channels": 32,
        "dropout": 0.0,
        "checkpointing": False,
    },
    "field": {"channels": 8, "hidden": 16, "density_shift": -1.0, "density_scale": 16.0},
    "render": {"uniform_samples": 6, "importance_samples": 6, "background": 1.0, "chunk": 10**6},
    "conditioning": {
        "name": "rendered",
        "image": "rendered",
        "ray_maps": False,
        "cross_attention": True,
        "residual_std": None,
    },
}


def config(**changes) -> dict:
    """CONFIG with some values changed, as config(unet={"width": 64})."""
    changed = copy.deepcopy(CONFIG)
    for key, values in changes.items():
        changed[key].update(values)
    return changed


def model(seed: int = 0, **changes) -> NerfDiff:
    torch.manual_seed(seed)
    return NerfDiff(**config(**changes))


def input_cameras(batch: int = 1, height: int = 16, width: int = 16) -> Cameras:
    """Cameras at the origin of their own space with SRN's field of view."""
    K = torch.tensor([[1.025 * width, 0, width / 2], [0, 1.025 * width, height / 2], [0, 0, 1]])
    return Cameras(torch.eye(4).repeat(batch, 1, 1), K.repeat(batch, 1, 1), height, width)


def look_at(centre, target=(0.0, 0.0, 1.3), down=(0.0, 1.0, 0.0)) -> torch.Tensor:
    """Camera-to-world of a camera at `centre`, written out by hand: x right, y down, z forward."""
    centre, target, down = (torch.tensor(v, dtype=torch.float64) for v in (centre, target, down))
    z = (target - centre) / (target - centre).norm()
    x = torch.linalg.cross(down, z)
    x = x / x.norm()
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3] = torch.stack([x, torch.linalg.cross(z, x), z, centre], 1)
    return c2w.float()
