"""A `Model` as Mitsuba shapes, under the light that all pictures of single objects share."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from procedural.colour import srgb_to_linear
from procedural.mesh import Colour, Model, Part
from procedural.texture import box_coordinates


@dataclass(frozen=True)
class ModelWorld:
    """One object alone, on nothing."""

    model: Model

    def entries(self, mi: Any) -> dict[str, Any]:
        """A bright sky all around plus a soft-edged sun from above and the front right.

        Tops are lightest, undersides darkest, and little depends on the viewing direction.
        """
        entries = {
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.70}},
            "sun": {
                "type": "directional",
                "direction": [-0.35, 0.45, -0.82],
                "irradiance": {"type": "rgb", "value": 1.5},
            },
        }
        groups: dict[tuple, list[Part]] = {}
        for part in self.model.parts:
            groups.setdefault((part.finish, part.colour, part.texture), []).append(part)
        for k, parts in enumerate(groups.values()):
            entries[f"mesh_{k:03d}"] = mesh(mi, parts)
        return entries

    def labels(self, points: Float[np.ndarray, "*image 3"]) -> Int[np.ndarray, "*image"]:
        return np.ones(points.shape[:-1], int)


def mesh(mi: Any, parts: list[Part]) -> Any:
    """One flat-shaded Mitsuba mesh of parts of one colour, finish and texture."""
    first = parts[0]
    if first.texture is None:
        reflectance = rgb(first.colour)
        offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
        vertices = np.concatenate([p.vertices for p in parts])
        faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)])
        uv = None
    else:
        pixels = np.ascontiguousarray(first.texture.pixels(first.colour))
        reflectance = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": False, "wrap_mode": "repeat"}
        # Corners are not shared: each triangle has its own place on the texture.
        corners = [part.vertices[part.faces] for part in parts]
        uv = np.concatenate([box_coordinates(c, first.texture) for c in corners]).reshape(-1, 2)
        vertices = np.concatenate(corners).reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)

    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf(first.finish, reflectance)})
    props["face_normals"] = True
    shape = mi.Mesh("parts", len(vertices), len(faces), props=props, has_vertex_texcoords=uv is not None)
    params = mi.traverse(shape)
    params["vertex_positions"] = type(params["vertex_positions"])(vertices.astype(np.float32).ravel())
    params["faces"] = type(params["faces"])(faces.astype(np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = type(params["vertex_texcoords"])(uv.astype(np.float32).ravel())
    params.update()
    return shape


def rgb(colour: Colour) -> dict[str, Any]:
    """A Mitsuba colour from sRGB."""
    return {"type": "rgb", "value": srgb_to_linear(np.array(colour)).tolist()}


def bsdf(finish: str, reflectance: dict[str, Any]) -> dict[str, Any]:
    """The reflectance model of one of `mesh.FINISHES`."""
    if finish == "matte":
        return {"type": "diffuse", "reflectance": reflectance}
    # A clear coat with a mild index of refraction: a hint of sheen over a diffuse colour.
    return {
        "type": "plastic",
        "diffuse_reflectance": reflectance,
        "int_ior": 1.30 if finish == "paint" else 1.45,
        "specular_reflectance": {"type": "rgb", "value": 0.5 if finish == "paint" else 0.9},
    }
