"""CLEVR's world for Mitsuba: a grey floor, three lamps with soft shadows, rubber and metal objects."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nerfdiff.poses import look_at_origin
from procedural.clevr.objects import ClevrObject
from procedural.mesh import box
from procedural.mitsuba_model import rgb

FLOOR = (0.52, 0.52, 0.51)
# CLEVR's key, fill and back lamps, moved outwards along their own directions until no camera that looks down
# on the table can see them: place and width, which decides their share of the light.
LAMPS = (((9.7, -4.4, 9.6), 4.3), ((-8.2, -7.0, 9.5), 3.2), ((-2.6, 5.8, 11.0), 2.8))
LAMP_RADIANCE = 25.0


@dataclass(frozen=True)
class ClevrWorld:
    """Floor, light and objects; object k of the tuple has label k + 1, the floor is background.

    Args:
        lamp_shift: how far each lamp stands from its usual place.
    """

    objects: tuple[ClevrObject, ...]
    lamp_shift: Float[np.ndarray, "lamps 3"]

    def entries(self, mi: Any) -> dict[str, Any]:
        to_world = mi.ScalarTransform4f()
        floor = {"type": "diffuse", "reflectance": rgb(FLOOR)}
        entries = {
            "ambient": {"type": "constant", "radiance": {"type": "rgb", "value": 0.37}},
            "floor": {"type": "rectangle", "to_world": to_world.scale([200, 200, 1]), "bsdf": floor},
        }
        # One mesh: the order in which Mitsuba keeps several emitters is not the same in every run.
        places = [np.add(place, shift) for (place, _), shift in zip(LAMPS, self.lamp_shift, strict=True)]
        lamps = [_facing_origin(place, width) for place, (_, width) in zip(places, LAMPS, strict=True)]
        entries["lamps"] = _mesh(
            mi,
            np.concatenate(lamps),
            np.concatenate([np.array([(0, 1, 2), (0, 2, 3)]) + 4 * k for k in range(len(lamps))]),
            {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": LAMP_RADIANCE}}},
        )
        for k, item in enumerate(self.objects):
            entries[f"object_{k + 1}"] = _shape(mi, item)
        return entries

    def labels(self, points: Float[np.ndarray, "*image 3"]) -> Int[np.ndarray, "*image"]:
        """The circles in which objects stand do not overlap, so a point's place on the floor tells whose it is."""
        found = np.zeros(points.shape[:-1], int)
        for k, item in enumerate(self.objects):
            within = np.hypot(points[..., 0] - item.x, points[..., 1] - item.y) < item.size + 1e-3
            found[within & (points[..., 2] > 1e-4)] = k + 1
        return found


def _shape(mi: Any, item: ClevrObject) -> Any:
    bsdf = _bsdf(item)
    if item.shape == "sphere":
        return {"type": "sphere", "center": [item.x, item.y, item.size], "radius": item.size, "bsdf": bsdf}
    if item.shape == "cube":
        half = item.half_height
        part = box("cube", (0, 0, 0), (2 * half,) * 3, item.srgb, bevel=0.07 * half)
        vertices, faces, normals = part.vertices, part.faces, None
    else:
        vertices, faces, normals = rounded_cylinder(item.size)
    angle = np.radians(item.rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    vertices = vertices @ turn.T + [item.x, item.y, item.half_height]

    return _mesh(mi, vertices, faces, {"bsdf": bsdf}, None if normals is None else normals @ turn.T)


def _mesh(
    mi: Any,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    plugins: dict[str, Any],
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> Any:
    """A mesh with these `plugins` (bsdf, emitter); flat where it has no `normals`."""
    props = mi.Properties()
    for name, plugin in plugins.items():
        props[name] = mi.load_dict(plugin)
    props["face_normals"] = normals is None
    shape = mi.Mesh("mesh", len(vertices), len(faces), props=props, has_vertex_normals=normals is not None)
    params = mi.traverse(shape)
    arrays = {"vertex_positions": vertices.astype(np.float32), "faces": faces.astype(np.uint32)}
    if normals is not None:
        arrays["vertex_normals"] = normals.astype(np.float32)
    for name, values in arrays.items():
        params[name] = type(params[name])(values.ravel())
    params.update()
    return shape


def _facing_origin(centre: Float[np.ndarray, "3"], width: float) -> Float[np.ndarray, "4 3"]:
    """Corners of a square, counter-clockwise seen from the origin."""
    x, y, _ = look_at_origin(centre)[:3, :3].T * width / 2
    return centre + np.stack([-x - y, x - y, x + y, -x + y])


def _bsdf(item: ClevrObject) -> dict[str, Any]:
    colour = rgb(item.srgb)
    if item.material == "rubber":
        return {"type": "roughplastic", "diffuse_reflectance": colour, "alpha": 0.35, "int_ior": 1.3}
    # Tinted and a little rough, as CLEVR's metal; lifted so that dark colours still mirror the room.
    tint = {"type": "rgb", "value": [min(1.0, 0.06 + 0.94 * value) for value in colour["value"]]}
    return {"type": "roughconductor", "material": "none", "alpha": 0.18, "specular_reflectance": tint}


def rounded_cylinder(
    size: float, segments: int = 64, bends: int = 4
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"], Float[np.ndarray, "n 3"]]:
    """Vertices, triangles and smooth normals of an upright cylinder around the origin.

    Its radius and half its height are `size`; the rims are rounded.
    """
    bevel = 0.07 * size
    lean = np.linspace(0, np.pi / 2, bends + 1)
    # From the top's middle over the rounded rim and down the side: radius, height, and the normal of both.
    rim = np.stack([size - bevel + bevel * np.sin(lean), size - bevel + bevel * np.cos(lean)], axis=1)
    upper = np.concatenate([[(0.0, size)], rim])
    slope = np.concatenate([[(0.0, 1.0)], np.stack([np.sin(lean), np.cos(lean)], axis=1)])
    profile = np.concatenate([upper, upper[::-1] * [1, -1]])
    slope = np.concatenate([slope, slope[::-1] * [1, -1]])
    around = np.arange(segments) * 2 * np.pi / segments
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)

    def revolved(values: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "n 3"]:
        flat = values[:, None, :1] * circle
        return np.concatenate([flat, np.broadcast_to(values[:, None, 1:], (*flat.shape[:2], 1))], -1).reshape(-1, 3)

    index = np.arange(len(profile) * segments).reshape(-1, segments)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    # Rings at the poles have no extent: triangles with two corners there vanish.
    corners = revolved(profile)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return revolved(profile), faces[area > 0], revolved(slope)
