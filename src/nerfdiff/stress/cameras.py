"""Errors in what a method is told of the cameras. The views to predict keep their true cameras."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch


def focal(scene: ViewBatch, severity: float) -> ViewBatch:
    """Multiply the input camera's focal lengths, and with them those of the virtual views."""
    K = scene.source_cameras.K.clone()
    K[..., 0, 0] *= severity
    K[..., 1, 1] *= severity
    return replace(scene, source_cameras=replace(scene.source_cameras, K=K))


def near_far(scene: ViewBatch, severity: float) -> ViewBatch:
    """Multiply both bounds, as a scene in another unit of length has them."""
    return replace(scene, near=scene.near * severity, far=scene.far * severity)


def pose_rotation(cameras: Cameras, severity: float, draws: torch.Generator, distance: float) -> Cameras:
    """Turn each camera by so many degrees about an axis of its own, through its own centre."""
    axes = torch.nn.functional.normalize(torch.randn(*cameras.shape, 3, generator=draws), dim=-1)
    turned = cameras.c2w.clone()
    turned[..., :3, :3] = cameras.c2w[..., :3, :3] @ _rotations(axes, severity).to(cameras.c2w)
    return replace(cameras, c2w=turned)


def pose_shift(cameras: Cameras, severity: float, draws: torch.Generator, distance: float) -> Cameras:
    """Move each camera by this share of its distance from the object, in a direction of its own."""
    directions = torch.nn.functional.normalize(torch.randn(*cameras.shape, 3, generator=draws), dim=-1)
    moved = cameras.c2w.clone()
    moved[..., :3, 3] += severity * distance * directions.to(cameras.c2w)
    return replace(cameras, c2w=moved)


def _rotations(axes: Float[Tensor, "*n 3"], degrees: float) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices about unit axes (Rodrigues)."""
    x, y, z = axes.unbind(-1)
    nothing = torch.zeros_like(x)
    cross = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross * torch.deg2rad(torch.tensor(float(degrees))))
