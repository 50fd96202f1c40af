"""Procedural cars: a lofted body with wheel arches, a tapered cabin, and the parts that tell front from back.

Metres while building; x to the sides, the front towards −y, z up, the ground at z = 0.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from procedural import car_ends, car_trim
from procedural.car_cabin import cabin
from procedural.car_proportions import Proportions, draw_proportions
from procedural.car_wheels import wheels
from procedural.mesh import Colour, Model, Part, loft
from procedural.paint import car_paint, pick


def _arch(p: Proportions, axle: float, steps: int = 11) -> list[tuple[float, float]]:
    """Stations (y, underside height) around one wheel, vertical walls at both ends."""
    radius = min(1.14 * p.wheel, min(p.top_at(axle - p.wheel), p.top_at(axle + p.wheel)) - p.wheel - 0.09)
    radius = max(radius, 0.98 * p.wheel)
    angles = np.linspace(np.pi, 0, steps)
    circle = [(axle + radius * np.cos(a), p.wheel + radius * np.sin(a)) for a in angles]
    return [(circle[0][0], p.clearance), *circle, (circle[-1][0], p.clearance)]


def _body_ring(y: float, bottom: float, top: float, half: float) -> Float[np.ndarray, "points 3"]:
    """Cross-section: a narrow sill, flat sides leaning in slightly, a rounded shoulder."""
    edge = min(0.06, (top - bottom) / 4)
    right = [
        (half - 0.5 * edge, bottom),
        (half, bottom + edge),
        (half - 0.012, top - 1.5 * edge),
        (half - 0.035, top - 0.4 * edge),
        (half - 0.10, top),
    ]
    profile = right + [(-x, z) for x, z in reversed(right)]
    return np.array([(x, y, z) for x, z in profile])


def body(p: Proportions, colour: Colour) -> Part:
    """The lower body with its wheel arches (and, for a pickup, its lowered bed)."""
    stations = [(y, p.clearance) for y in (p.front + 0.06, p.front + 0.14, p.front + 0.30)]
    stations = [(p.front, p.clearance + 0.10), *stations]
    stations += _arch(p, p.front_axle) + [(y, p.clearance) for y in (p.cowl, p.cabin_rear, p.cabin_rear + 0.01)]
    stations += _arch(p, p.rear_axle)
    stations += [(y, p.clearance) for y in (p.rear - 0.25, p.rear - 0.10)] + [(p.rear, p.clearance + 0.10)]
    # A stable sort keeps the order of the two stations of a vertical wall; stations that fall inside an
    # arch would fill it, so they go.
    arches = [(a[0][0], a[-1][0]) for a in (_arch(p, p.front_axle), _arch(p, p.rear_axle))]
    kept = [s for s in stations if not any(a < s[0] < b and s[1] <= p.clearance for a, b in arches)]
    kept.sort(key=lambda s: s[0])
    rings = np.stack([_body_ring(y, z, p.top_at(y), p.half_width_at(y)) for y, z in kept])
    return loft("body", rings, colour, "paint")


def build_car(rng: np.random.Generator, styles: Mapping[str, int | float]) -> Model:
    """One car, normalised to the unit diagonal and facing −y.

    Args:
        rng: the only source of randomness.
        styles: weight of each body style (keys of `STYLES`).
    """
    style = pick(rng, styles)
    p = draw_proportions(style, rng)
    paint = car_paint(rng, style)
    parts = [body(p, paint.body)]
    parts += car_trim.underbody(p)
    parts += cabin(p, paint, rng)
    parts += wheels(p, rng)
    parts += car_ends.front_end(p, paint, rng)
    parts += car_ends.rear_end(p, paint, rng)
    parts += car_trim.trim(p, paint, rng)
    if style == "pickup":
        parts += car_trim.pickup_bed(p, paint)
    return Model(style, tuple(parts)).normalised()
