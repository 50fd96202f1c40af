"""Geometry against ground truth: depth error where both agree that something is there, and coverage."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras


def z_depth(distance: Float[Tensor, "*batch h w"], cameras: Cameras) -> Float[Tensor, "*batch h w"]:
    """Distance along the (unit) ray of each pixel to depth along the camera's z axis, as in `Scene.depth`."""
    u, v = cameras.pixel_centres().unbind(-1)
    fx, fy, cx, cy = (cameras.K[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return distance / (1 + ((u - cx) / fx).square() + ((v - cy) / fy).square()).sqrt()


def depth_errors(
    depth: Float[Tensor, "n h w"],
    opacity: Float[Tensor, "n h w"],
    truth: Float[Tensor, "n h w"],
    threshold: float,
) -> tuple[list[float | None], list[float | None]]:
    """Mean absolute relative error |d − d*| / d*, and RMSE in scene units, of each image.

    Measured where `truth` is above 0 (something was hit) and `opacity` above `threshold`; None for an image
    without such pixels. Both depths are along z; `depth` is that of the surface, not weighted by opacity.
    """
    relative, rmse = [], []
    for d, o, t in zip(depth.double(), opacity, truth.double(), strict=True):
        both = (t > 0) & (o > threshold)
        if not both.any():
            relative.append(None)
            rmse.append(None)
            continue
        error = d[both] - t[both]
        relative.append((error.abs() / t[both]).mean().item())
        rmse.append(error.square().mean().sqrt().item())
    return relative, rmse


def mask_iou(opacity: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"], threshold: float) -> list[float]:
    """Coverage of each image: intersection over union of `opacity > threshold` and `mask`; 1 if both are empty.

    Blank scenes have empty masks, and leaving them empty is right.
    """
    covered = opacity > threshold
    intersection = (covered & mask).sum(dim=(1, 2)).double()
    union = (covered | mask).sum(dim=(1, 2)).double()
    return torch.where(union > 0, intersection / union, 1.0).tolist()
