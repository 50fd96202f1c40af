"""Meshes and point clouds as files of other programs, in their convention.

Files are right-handed with y up, as glTF asks. The origin is what the cameras look at, z points from there to the
input camera's side, x to the right in the input picture. Lengths are scene units, as in the field.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.exports.surface import Surface
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import atomic

COLOUR = "_COLOUR"  # trimesh writes such an attribute as it is; then it takes glTF's name


def to_y_up(points: Float[Tensor, "n 3"], source: Cameras, stands: Upright) -> Float[Tensor, "n 3"]:
    """Points of the input camera's space in the convention of files."""
    return (points - stands.point) @ stands.axes(source).T


def write_mesh(path: Path, surface: Surface, source: Cameras, stands: Upright) -> Path:
    """Write a mesh with coloured corners, as `.glb`, `.obj` or whatever else trimesh knows.

    A GLB's colours are linear, as glTF asks, and its material is unlit: the light is in the colours.

    Raises:
        ConfigError: trimesh is not installed.
        DataError: the file cannot be written.
    """
    trimesh = _trimesh()
    points, normals = (to_y_up(at, source, stands).numpy() for at in (surface.points, surface.normals + stands.point))
    rgba = torch.cat([surface.colours, torch.ones(len(points), 1)], 1).numpy()
    common = {"vertices": points, "faces": surface.faces, "vertex_normals": normals, "process": False}
    with atomic(path) as temporary:
        if path.suffix == ".glb":
            linear = np.rint(np.c_[_linear(rgba[:, :3]), rgba[:, 3]] * 65535).astype(np.uint16)
            mesh = trimesh.Trimesh(**common, vertex_attributes={COLOUR: linear})
            mesh.export(temporary, include_normals=True, tree_postprocessor=_as_seen)
        else:
            trimesh.Trimesh(**common, vertex_colors=_bytes(rgba)).export(temporary)
    return path


def write_points(path: Path, surface: Surface, source: Cameras, stands: Upright, count: int) -> Path:
    """Write `count` coloured points spread evenly over a surface, as `.ply`.

    Raises:
        ConfigError, DataError: see `write_mesh`.
    """
    trimesh, generator = _trimesh(), np.random.default_rng(0)
    corners = to_y_up(surface.points, source, stands).numpy()[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = generator.choice(len(corners), count, p=area / area.sum())
    weights = generator.dirichlet(np.ones(3), count)[..., None]
    colours = (surface.colours.numpy()[surface.faces[chosen]] * weights).sum(1)
    cloud = trimesh.PointCloud((corners[chosen] * weights).sum(1), _bytes(np.c_[colours, np.ones(count)]))
    with atomic(path) as temporary:
        cloud.export(temporary)
    return path


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError("meshes and point clouds need trimesh: pip install trimesh") from error
    return trimesh


def _as_seen(tree: dict[str, Any]) -> None:
    """Make the colours the mesh's own, of a material that no light changes."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop(COLOUR)
    tree["accessors"][attributes["COLOR_0"]]["normalized"] = True
    unlit = "KHR_materials_unlit"
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0}, "extensions": {unlit: {}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["extensionsUsed"] = [*tree.get("extensionsUsed", ()), unlit]


def _linear(srgb: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _bytes(shares: np.ndarray) -> np.ndarray:
    return np.rint(shares.clip(0, 1) * 255).astype(np.uint8)
