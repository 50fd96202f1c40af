"""Triangle meshes of coloured parts, made with numpy alone.

Objects are modelled in metres (z up, front towards −y) and brought to the unit bounding-box diagonal of
ShapeNet by `Model.normalised`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, Real

from procedural.texture import Colour, Texture

Point = Sequence[int | float] | Real[np.ndarray, "3"]
Numbers = Sequence[int | float] | Real[np.ndarray, "numbers"]
FINISHES = ("matte", "paint", "glass")


@dataclass(frozen=True)
class Part:
    """One closed surface of one colour or texture.

    Args:
        name: what it is (`headlight`, `seat`, …); several parts may share a name.
        vertices: corner points.
        faces: triangles, counter-clockwise seen from outside.
        colour: sRGB in [0, 1].
        finish: one of `FINISHES`; says which reflectance model the renderer uses.
        texture: a pattern over the colour.
    """

    name: str
    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colour: Colour
    finish: str = "matte"
    texture: Texture | None = None

    def volume(self) -> float:
        """Signed volume: positive where the faces point outwards."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)

    def mirrored(self) -> "Part":
        """The same part on the other side of the plane x = 0."""
        return replace(self, vertices=self.vertices * [-1.0, 1.0, 1.0], faces=self.faces[:, ::-1])


@dataclass(frozen=True)
class Model:
    """One object.

    Args:
        style: the kind within its category (`sedan`, `armchair`, …).
        parts: its surfaces.
    """

    style: str
    parts: tuple[Part, ...]

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of the axis-aligned bounding box."""
        points = np.concatenate([part.vertices for part in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def normalised(self) -> "Model":
        """Centred on the origin, the bounding box's diagonal being 1 (ShapeNet's convention)."""
        low, high = self.bounds()
        centre, scale = (low + high) / 2, 1 / np.linalg.norm(high - low)
        parts = (
            replace(p, vertices=(p.vertices - centre) * scale, texture=p.texture and p.texture.scaled(float(scale)))
            for p in self.parts
        )
        return replace(self, parts=tuple(parts))

    def moved(self, offset: Point) -> "Model":
        """The same object elsewhere."""
        return replace(self, parts=tuple(replace(p, vertices=p.vertices + np.asarray(offset)) for p in self.parts))

    def named(self, name: str) -> tuple[Part, ...]:
        """The parts of this name."""
        return tuple(part for part in self.parts if part.name == name)


def loft(name: str, rings: Real[np.ndarray, "rings points 3"], colour: Colour, finish: str = "matte") -> Part:
    """A closed surface through consecutive rings; the first and last one, both convex, are capped."""
    count, points = rings.shape[:2]
    vertices = rings.reshape(-1, 3).astype(np.float64)
    here = np.arange(points)
    after = (here + 1) % points
    faces = []
    for ring in range(count - 1):
        a, b = ring * points, (ring + 1) * points
        faces.append(np.stack([a + here, a + after, b + after], axis=1))
        faces.append(np.stack([a + here, b + after, b + here], axis=1))
    fan = np.stack([np.zeros(points - 2, int), here[2:], here[1:-1]], axis=1)
    faces += [fan, fan[:, ::-1] + (count - 1) * points]
    part = Part(name, vertices, np.concatenate(faces), colour, finish)
    return replace(part, faces=part.faces[:, ::-1]) if part.volume() < 0 else part


def box(
    name: str,
    centre: Point,
    size: Point,
    colour: Colour,
    finish: str = "matte",
    bevel: int | float = 0.0,
) -> Part:
    """An axis-aligned box whose edges are cut off by `bevel` (limited to a third of the shortest side)."""
    half = np.asarray(size, np.float64) / 2
    bevel = min(bevel, 2 / 3 * float(half.min()))
    levels = [(-half[2], bevel), (-half[2] + bevel, 0.0), (half[2] - bevel, 0.0), (half[2], bevel)]
    if bevel == 0:
        levels = [(-half[2], 0.0), (half[2], 0.0)]
    rings = np.stack([chamfered_rectangle(half[0] - cut, half[1] - cut, bevel, z) for z, cut in levels])
    return loft(name, rings + np.asarray(centre, np.float64), colour, finish)


def chamfered_rectangle(
    half_x: int | float, half_y: int | float, cut: int | float, z: int | float
) -> Real[np.ndarray, "points 3"]:
    """A horizontal rectangle around the z axis with its corners cut off (four points where `cut` is 0)."""
    if cut == 0:
        corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
    else:
        x, y = half_x - cut, half_y - cut
        corners = [(-x, -half_y), (x, -half_y), (half_x, -y), (half_x, y)]
        corners += [(x, half_y), (-x, half_y), (-half_x, y), (-half_x, -y)]
    return np.array([(*corner, z) for corner in corners])


def tube(
    name: str,
    start: Point,
    end: Point,
    radii: Numbers,
    colour: Colour,
    finish: str = "matte",
    segments: int = 12,
    positions: Numbers | None = None,
) -> Part:
    """A round bar from `start` to `end` with these radii at `positions` (in [0, 1], even by default)."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angles = (np.arange(segments) + 0.5) * 2 * np.pi / segments
    circle = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
    steps = np.linspace(0, 1, len(radii)) if positions is None else positions
    rings = np.stack([start + t * (end - start) + r * circle for t, r in zip(steps, radii, strict=True)])
    return loft(name, rings, colour, finish)


def panel(
    name: str,
    corners: Real[np.ndarray, "corners 3"],
    colour: Colour,
    finish: str = "matte",
    thickness: float = 0.02,
    proud: float = 0.006,
) -> Part:
    """A thin plate lying on a surface: `corners` go counter-clockwise seen from outside.

    It stands out by `proud` and reaches `thickness` below, so that no two surfaces coincide.
    """
    corners = np.asarray(corners, np.float64)
    normal = np.cross(corners[1] - corners[0], corners[-1] - corners[0])
    normal /= np.linalg.norm(normal)
    return loft(name, np.stack([corners + proud * normal, corners - thickness * normal]), colour, finish)


def slab(
    name: str,
    upper: Real[np.ndarray, "rows columns 3"],
    lower: Real[np.ndarray, "rows columns 3"],
    colour: Colour,
    finish: str = "matte",
) -> Part:
    """A closed curved sheet between two grids of points, joined along their rims."""
    rows, columns = upper.shape[:2]
    vertices = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)]).astype(np.float64)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    after, below = np.roll(rim, -1), rows * columns
    sides = np.concatenate([np.stack([after, rim, rim + below], 1), np.stack([after, rim + below, after + below], 1)])
    part = Part(name, vertices, np.concatenate([top, top[:, ::-1] + below, sides]), colour, finish)
    return replace(part, faces=part.faces[:, ::-1]) if part.volume() < 0 else part


def both_sides(part: Part) -> list[Part]:
    """A part and its mirror image."""
    return [part, part.mirrored()]
