"""Pieces that several kinds of chair share: bars, legs, curved sheets, arm rests, star bases.

Metres; x to the sides, the sitter looks towards −y, z up, the ground at z = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from procedural.mesh import Colour, Numbers, Part, Point, box, slab, tube
from procedural.paint import jitter, pick

WOODS: dict[str, tuple[int, Colour]] = {
    "beech": (4, (0.80, 0.64, 0.44)),
    "oak": (5, (0.66, 0.47, 0.28)),
    "cherry": (3, (0.55, 0.27, 0.15)),
    "walnut": (4, (0.36, 0.22, 0.13)),
    "black": (3, (0.10, 0.09, 0.09)),
    "white": (3, (0.90, 0.89, 0.86)),
    "green": (1, (0.24, 0.42, 0.32)),
    "blue": (1, (0.20, 0.34, 0.52)),
}
METALS: dict[str, tuple[int, Colour]] = {
    "chrome": (5, (0.70, 0.71, 0.73)),
    "black": (4, (0.10, 0.10, 0.11)),
    "white": (2, (0.90, 0.90, 0.90)),
    "brass": (1, (0.75, 0.58, 0.26)),
}
FABRICS: dict[str, tuple[int, Colour]] = {
    "red": (4, (0.72, 0.12, 0.12)),
    "wine": (2, (0.42, 0.08, 0.14)),
    "orange": (3, (0.90, 0.46, 0.12)),
    "mustard": (3, (0.84, 0.65, 0.16)),
    "olive": (2, (0.42, 0.44, 0.20)),
    "green": (3, (0.14, 0.45, 0.28)),
    "teal": (3, (0.10, 0.45, 0.48)),
    "blue": (4, (0.16, 0.32, 0.66)),
    "navy": (2, (0.11, 0.15, 0.32)),
    "purple": (2, (0.40, 0.22, 0.52)),
    "pink": (2, (0.86, 0.52, 0.58)),
    "cream": (4, (0.88, 0.83, 0.72)),
    "grey": (4, (0.52, 0.53, 0.55)),
    "charcoal": (4, (0.22, 0.22, 0.24)),
    "brown": (3, (0.40, 0.26, 0.17)),
}


def draw_colour(rng: np.random.Generator, palette: dict[str, tuple[int, Colour]]) -> Colour:
    """A colour of `palette`, drawn by weight and varied slightly."""
    return jitter(rng, palette[pick(rng, {name: weight for name, (weight, _) in palette.items()})][1])


@dataclass(frozen=True)
class Seat:
    """The measures nearly every chair has: width, depth, seat height, top of the back, recline."""

    width: float
    depth: float
    height: float
    top: float
    lean: float

    @property
    def front(self) -> float:
        return -self.depth / 2

    @property
    def rear(self) -> float:
        return self.depth / 2

    def back_at(self, z: float) -> float:
        """y of the leaning back at height z."""
        return self.rear + self.lean * (z - self.height) / (self.top - self.height)


def draw_seat(rng: np.random.Generator, **ranges: tuple[float, float]) -> Seat:
    """Draw the measures of a seat; `ranges` replace the usual ones."""
    usual = {"width": (0.40, 0.54), "depth": (0.40, 0.52), "height": (0.42, 0.48), "top": (0.80, 1.08)}
    usual |= {"lean": (0.03, 0.16)}
    return Seat(**{name: float(rng.uniform(*bounds)) for name, bounds in (usual | ranges).items()})


def bar(
    name: str,
    start: Point,
    end: Point,
    thickness: float,
    colour: Colour,
    round_: bool = True,
    taper: float = 1.0,
    finish: str = "matte",
) -> Part:
    """A straight bar of this thickness at `start` and `taper` times that at `end`, round or square."""
    radius = thickness / 2 if round_ else thickness / np.sqrt(2)
    return tube(name, start, end, [radius, radius * taper], colour, finish, segments=10 if round_ else 4)


def pipe(name: str, points: Sequence[Point], thickness: float, colour: Colour, finish: str = "paint") -> list[Part]:
    """A bent round bar through `points`; the pieces overlap so that the bends are filled."""
    parts = []
    for a, b in pairwise(points):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        reach = 0.45 * thickness * (b - a) / np.linalg.norm(b - a)
        parts.append(bar(name, a - reach, b + reach, thickness, colour, finish=finish))
    return parts


def sheet(
    name: str,
    path: Sequence[tuple[int | float, int | float]],
    half_widths: Numbers,
    thickness: float,
    colour: Colour,
    bowl: float = 0.0,
    finish: str = "matte",
    columns: int = 9,
) -> Part:
    """A sheet that follows `path` (y, z) and spans ±`half_widths` in x.

    Its edges are raised by `bowl` towards the left of the path's direction (up, for a path along +y).
    """
    path, half_widths = np.asarray(path, np.float64), np.asarray(half_widths, np.float64)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    across = np.linspace(-1, 1, columns)
    rise = bowl * across**2
    upper = np.zeros((len(path), columns, 3))
    upper[..., 0] = half_widths[:, None] * across
    upper[..., 1:] = path[:, None] + rise[:, None] * normal[:, None]
    lower = upper.copy()
    lower[..., 1:] -= thickness * normal[:, None]
    return slab(name, upper, lower, colour, finish)


def smooth_path(points: Sequence[tuple[float, float]], steps: int = 4) -> list[tuple[float, float]]:
    """Catmull–Rom curve through `points`, `steps` pieces between neighbours."""
    p = np.asarray([points[0], *points, points[-1]], np.float64)
    curve = []
    for k in range(len(points) - 1):
        a, b, c, d = p[k : k + 4]
        for t in np.arange(steps) / steps:
            curve.append(
                0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
            )
    return [tuple(x) for x in curve] + [tuple(points[-1])]


def four_legs(
    seat: Seat, rng: np.random.Generator, colour: Colour, splay: float, top: float, round_: bool, finish="matte"
) -> list[Part]:
    """Four legs from under the seat (height `top`) to the ground, spread outwards by `splay`."""
    thick, taper = float(rng.uniform(0.030, 0.050)), float(rng.uniform(0.55, 1.0))
    inset = thick / 2 + 0.01 + 0.5 * splay
    parts = []
    for x in (-1, 1):
        for y in (-1, 1):
            start = np.array([x * (seat.width / 2 - inset), y * (seat.depth / 2 - inset), top])
            end = np.array([start[0] + x * splay, start[1] + y * splay, 0.0])
            parts.append(bar("leg", start, end, thick, colour, round_, taper, finish))
    return parts


def stretchers(
    seat: Seat, rng: np.random.Generator, colour: Colour, round_: bool, splay: float = 0.0, z: float | None = None
) -> list[Part]:
    """Bars between the legs: two at the sides, and one across."""
    z = float(rng.uniform(0.12, 0.22)) if z is None else z
    x, y = seat.width / 2 - 0.03 + 0.3 * splay, seat.depth / 2 - 0.03 + 0.3 * splay
    parts = [bar("stretcher", (s * x, -y, z), (s * x, y, z), 0.022, colour, round_) for s in (-1, 1)]
    across = 0.0 if rng.random() < 0.6 else -y
    return [*parts, bar("stretcher", (-x, across, z), (x, across, z), 0.022, colour, round_)]


def post_arms(seat: Seat, rng: np.random.Generator, colour: Colour, round_: bool) -> list[Part]:
    """Arm rests from the back to posts that stand on the seat's front half."""
    z = seat.height + float(rng.uniform(0.19, 0.26))
    x, front = seat.width / 2 - 0.005, seat.front + float(rng.uniform(0.03, 0.14))
    parts = []
    for s in (-1, 1):
        parts.append(bar("arm_post", (s * x, front, seat.height - 0.04), (s * x, front, z), 0.03, colour, round_))
        stop = seat.back_at(z) + 0.01
        length = stop - front + 0.04
        place = (s * x, (front - 0.04 + stop) / 2, z + 0.01)
        parts.append(box("arm", place, (0.05, length, 0.03), colour, bevel=0.01))
    return parts


def star_base(rng: np.random.Generator, metal: Colour, top: float, spread: float) -> list[Part]:
    """Five spokes on castors around a gas spring that carries the seat at height `top`."""
    turn = float(rng.uniform(0, 2 * np.pi))
    widths, places = [0.032, 0.032, 0.02, 0.02], [0, 0.5, 0.52, 1]
    parts = [tube("column", (0, 0, 0.07), (0, 0, top), widths, metal, "paint", positions=places)]
    dark: Colour = (0.08, 0.08, 0.085)
    for k in range(5):
        angle = turn + 2 * np.pi * k / 5
        direction = np.array([np.cos(angle), np.sin(angle), 0])
        foot = spread * direction + [0, 0, 0.075]
        parts.append(bar("base", [0, 0, 0.11], foot, 0.055, metal, round_=False, taper=0.6, finish="paint"))
        side = np.array([-direction[1], direction[0], 0]) * 0.022
        wheel = foot - [0, 0, 0.045]
        parts.append(tube("castor", wheel - side, wheel + side, [0.03, 0.03], dark, segments=10))
    return parts
