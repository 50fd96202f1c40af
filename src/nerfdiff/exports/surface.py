"""A coloured triangle mesh of a field."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from skimage.measure import label, marching_cubes
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.exports.backdrop import Backdrop, BackdropSettings
from nerfdiff.exports.views import render_rays
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError, DataError

COSINE = 0.2
"""Least cosine between a surface's normal and the direction to a camera whose colour it takes."""


@dataclass(frozen=True)
class Surface:
    """Triangles whose corners have colours, in the input camera's space and scene units; normals point outwards."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    colours: Float[Tensor, "n 3"]
    faces: Int[np.ndarray, "m 3"]


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings by which a surface is found in a field.

    What is kept of the field is what lies in the ball around the middle of the scene that all cameras at the input
    camera's distance have between near and far.

    Args:
        resolution: points of the grid along each axis.
        density: at the surface, in units of 1 / (far − near): at 15, 5 % of the scene's depth take half of the
            light.
        speck: parts smaller than this share of the largest one are left out.
        colour_views: cameras around the scene that colours are taken from, beside the input camera.
        input_weight: of the input camera's colours against the others', where it sees a point.
        backdrop: tells what only repeats the background; it is left out.

    Raises:
        ConfigError: values that are impossible.
    """

    resolution: int
    density: float
    speck: float
    colour_views: int
    input_weight: float
    backdrop: BackdropSettings

    def __post_init__(self):
        for key, possible, expected in (
            ("resolution", 8 <= self.resolution <= 1024, "8 to 1024"),
            ("density", self.density > 0, "more than 0"),
            ("speck", 0 <= self.speck <= 1, "a share within [0, 1]"),
            ("colour_views", self.colour_views >= 0, "at least 0"),
            ("input_weight", self.input_weight > 0, "more than 0"),
        ):
            if not possible:
                raise ConfigError(f"mesh.{key}={getattr(self, key)}: expected {expected}")

    def surface(self, saved: SavedField, stands: Upright, backdrop: Backdrop | None) -> Surface:
        """Return the surface where the field's density passes `density`, coloured as cameras around it see it.

        Args:
            backdrop: tells what is left out.

        Raises:
            DataError: the field is empty there.
        """
        points, faces = self._triangles(saved, stands, backdrop)
        normals = _normals(points, faces)
        colours = self._colours(saved, stands, points, normals)
        if backdrop is not None:
            colours = backdrop.painted_over(points, colours, faces)
        return Surface(points, normals, colours, faces)

    @torch.no_grad()
    def _triangles(
        self, saved: SavedField, stands: Upright, backdrop: Backdrop | None
    ) -> tuple[Float[Tensor, "n 3"], Int[np.ndarray, "m 3"]]:
        field, n = saved.field.field(), self.resolution
        depth = float(saved.field.far[0] - saved.field.near[0])
        axis = torch.linspace(-depth / 2, depth / 2, n)
        volume = np.zeros((n, n, n), np.float32)
        for i, x in enumerate(axis):  # a slice at a time, of which the ball takes a disc
            y, z = torch.meshgrid(axis, axis, indexing="ij")
            offsets = torch.stack([x.expand_as(y), y, z], -1)
            within = offsets.norm(dim=-1) < depth / 2
            if within.any():
                points = offsets[within] + stands.point.cpu()
                at = points[None].to(saved.field.K.device)
                rgb, density = (part[0].cpu() for part in field(at, torch.zeros_like(at)))
                if backdrop is not None:
                    alike = backdrop.repeats(rgb) & (density * depth >= self.density)
                    density[alike] *= ~backdrop.alone(points[alike])
                volume[i][within.numpy()] = density.numpy() * depth
        if not (volume >= self.density).any():
            raise DataError(
                f"the field is empty: its density is at most {volume.max():.3g} / (far - near), and mesh.density is "
                f"{self.density}. Lower mesh.density, or distil the scene again"
            )
        solid = _of_one_piece(volume >= self.density, self.speck)
        volume = np.where(solid, np.maximum(volume, self.density), np.minimum(volume, 0.999 * self.density))
        # interpolated where it is linear in the light that is kept, as the field looks
        kept, level = np.exp(-volume / n), math.exp(-self.density / n)
        corners, faces, _, _ = marching_cubes(kept, level, gradient_direction="descent")
        step = depth / (n - 1)
        points = torch.from_numpy(corners.astype(np.float32)) * step - depth / 2 + stands.point.cpu()
        return points, faces

    @torch.no_grad()
    def _colours(
        self, saved: SavedField, stands: Upright, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Mean of what cameras that face a point, and see it before anything else, see of it."""
        source, near, far = saved.field.cameras.to("cpu"), float(saved.field.near[0]), float(saved.field.far[0])
        share = torch.arange(self.colour_views) / max(1, self.colour_views)
        around = stands.around(source, 720 * share + 45, 5 + 65 * share)
        before = 2 * (far - near) / self.resolution + 0.02 * (far - near)
        total, weights = torch.zeros_like(points), torch.zeros(len(points))
        for view, centre in enumerate(Cameras.join([source, around]).centres):
            towards = centre - points
            distance = towards.norm(dim=-1)
            cosine = (towards * normals).sum(-1) / distance
            faced = (cosine > COSINE) & (distance > near)
            rgb, alpha, seen = self._along(saved, centre, -towards[faced], near, far)
            weight = cosine[faced] ** 2 * alpha * (seen > distance[faced] - before)
            weight = weight * (self.input_weight if view == 0 else 1.0)
            total[faced] += rgb * weight[:, None]
            weights[faced] += weight
        unseen = weights < 1e-3
        if unseen.any():  # from a step before the surface, at right angles
            step = 0.05 * (far - near)
            rgb, _, _ = self._along(saved, points[unseen] + step * normals[unseen], -normals[unseen], 0.0, 2 * step)
            total[unseen], weights[unseen] = rgb, 1.0
        return total / weights[:, None]

    @staticmethod
    def _along(saved, origins, directions, near, far):
        device, n = saved.field.K.device, len(directions)
        directions = torch.nn.functional.normalize(directions, dim=-1)
        bounds = (torch.full((n,), value) for value in (near, far))
        rays = Rays(origins.expand(n, 3), directions, *bounds)
        rays = Rays(*(part.to(device) for part in (rays.origins, rays.directions, rays.near, rays.far)))
        return (part.cpu() for part in render_rays(saved, rays))


def _of_one_piece(solid: Bool[np.ndarray, "n n n"], share: float) -> Bool[np.ndarray, "n n n"]:
    """Leave out parts smaller than this share of the largest one, and fill what cannot be reached from outside."""
    parts = label(solid, connectivity=3)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = (sizes >= share * max(1, sizes.max()))[parts] & solid
    empty = label(~kept, connectivity=1)
    return empty != empty[0, 0, 0]  # a grid's corner lies outside its ball


def _normals(points: Float[Tensor, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[Tensor, "n 3"]:
    """Return unit normals of the corners: of the triangles around them, by their areas."""
    index = torch.from_numpy(np.ascontiguousarray(faces)).long()
    a, b, c = (points[index[:, corner]] for corner in range(3))
    across = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(points)
    for corner in range(3):
        normals.index_add_(0, index[:, corner], across)
    return torch.nn.functional.normalize(normals, dim=-1)
