"""Pieces that several products share."""

from dataclasses import replace

import numpy as np

from procedural.chair_parts import bar
from procedural.mesh import Part, Point, loft

# Materials replace the colour that parts are made with.
GREY = (0.5, 0.5, 0.5)


def corner_legs(
    name: str,
    reach: tuple[float, float],
    top: float,
    thickness: float,
    splay: float = 0.0,
    taper: float = 0.7,
    round_: bool = True,
) -> list[Part]:
    """Four bars from (±reach, top) to the ground, spread outwards by `splay`."""
    x, y = reach
    ends = [(sx, sy) for sx in (-1, 1) for sy in (-1, 1)]
    return [
        bar(name, (sx * x, sy * y, top), (sx * (x + splay), sy * (y + splay), 0), thickness, GREY, round_, taper)
        for sx, sy in ends
    ]


def leaning(part: Part, foot: float, slope: float) -> Part:
    """`part` sheared towards +y by `slope` per unit of height above `foot`."""
    vertices = part.vertices.copy()
    vertices[:, 1] += slope * (vertices[:, 2] - foot)
    return replace(part, vertices=vertices)


def turned(part: Part, angle: float) -> Part:
    """`part` turned about the z axis, in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return replace(part, vertices=part.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))


def shifted(part: Part, offset: Point) -> Part:
    """`part` elsewhere."""
    return replace(part, vertices=part.vertices + np.asarray(offset, np.float64))


def pillow(name: str, centre: Point, size: Point) -> Part:
    """A cushion: thick in the middle, thin at its rim; `size` across x, thickness y, height z."""
    half = np.asarray(size, np.float64) / 2
    angles = (np.arange(24) + 0.5) * 2 * np.pi / 24
    # A squircle keeps the corners of a square cushion.
    outline = np.stack([np.sign(f(angles)) * np.abs(f(angles)) ** 0.45 for f in (np.cos, np.sin)], axis=1)
    rings = [
        np.stack([s * half[0] * outline[:, 0], np.full(24, t * half[1]), s * half[2] * outline[:, 1]], axis=1)
        for s, t in ((0.3, -1), (0.75, -0.75), (0.95, -0.3), (1.0, 0), (0.95, 0.3), (0.75, 0.75), (0.3, 1))
    ]
    return loft(name, np.stack(rings) + np.asarray(centre, np.float64), GREY)
