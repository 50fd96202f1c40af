"""Near and far against where the scene is."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.camera_checks import turn
from nerfdiff.inspection.check import Finding
from nerfdiff.metrics.depth import z_depth
from nerfdiff.trajectories import look_at_point


def ray_distance(depth: Float[Tensor, "views h w"], cameras: Cameras) -> Float[Tensor, "views h w"]:
    """Depth along z to distance along the ray of each pixel."""
    return depth / z_depth(torch.ones_like(depth), cameras)


def scene_distances(scene: Scene) -> tuple[Float[Tensor, " n"], str]:
    """Find how far from the cameras the scene is, and by which evidence.

    Returns:
        ray distances of every pixel that hit something, "surfaces"; without depth the cameras' distances from where
        their optical axes meet, "look-at point"; empty where the axes are parallel.
    """
    if scene.depth is not None:
        cameras, depth = scene.cameras.to(torch.float64), scene.depth.double()
        return ray_distance(depth, cameras)[depth > 0], "surfaces"
    cameras = scene.cameras.to(torch.float64)
    if len(cameras) < 2 or turn(cameras) == 0:
        return torch.empty(0, dtype=torch.float64), "look-at point"
    return (look_at_point(cameras) - cameras.centres).norm(dim=1), "look-at point"


@dataclass(frozen=True)
class Bounds:
    """Check that near and far enclose the visible surface; without depth, the point the cameras look at.

    Where the background is a real one (None), surfaces beyond far belong to it and are drawn at far: only what masks
    hold must lie between, and where there are no masks, nothing nearer than near.

    Args:
        background: grey level behind everything, as of the data.
        max_outside: share of the pixels with depth (or of the cameras) for which it may not.
        tolerance: of the comparison, relative to the distance.
        min_turn: as of `OpticalAxes`, for data without depth.
    """

    background: float | None
    max_outside: float
    tolerance: float
    min_turn: float
    tolerated: float

    measures: ClassVar[str] = "share outside of near to far"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = False
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        near, far = scene.near, scene.far
        if not 0 < near < far < float("inf"):
            return Finding.judged(1.0, f"near = {near} and far = {far} must satisfy 0 < near < far")
        if scene.depth is None and (len(scene.views) < 2 or turn(scene.cameras) < self.min_turn):
            return Finding.unchecked("no depth, and the optical axes are near-parallel")
        far_counts = self.background is not None or scene.depth is None or scene.mask is not None
        if self.background is None and scene.depth is not None and scene.mask is not None:
            scene = replace(scene, depth=scene.depth * scene.mask)
        distances, evidence = scene_distances(scene)
        if not len(distances):
            return Finding.unchecked("no pixel has depth")
        outside = distances < near * (1 - self.tolerance)
        if far_counts:
            outside |= distances > far * (1 + self.tolerance)
        share = outside.double().mean().item()
        reason = None
        if share > self.max_outside:
            what = "surfaces" if evidence == "surfaces" else "what the cameras look at"
            reason = (
                f"{what} at distances of {distances.min():.3g} to {distances.max():.3g}, near = {near:.3g} and "
                f"far = {far:.3g}: {share:.1%} outside"
            )
        return Finding.judged(share, reason)
