"""Dining, side and coffee tables. Metres; z up, the ground at z = 0, the front towards −y."""

import numpy as np

from procedural.chair_parts import bar
from procedural.mesh import Part, box, loft, tube
from procedural.products.materials import metal, stone, wood
from procedural.products.pieces import GREY, corner_legs


def table(rng: np.random.Generator) -> list[Part]:
    """A rectangular or round top on four legs, a column, trestles or hairpins, perhaps with a shelf."""
    low = rng.random() < 0.4
    height = float(rng.uniform(0.38, 0.50) if low else rng.uniform(0.70, 0.78))
    round_ = rng.random() < 0.35
    thick = float(rng.uniform(0.025, 0.05))
    timber = wood(rng)
    top_material = timber if rng.random() < 0.65 else stone(rng)
    frame = timber if rng.random() < 0.6 else metal(rng)
    if round_:
        width = depth = float(rng.uniform(0.45, 0.95))
        top = tube("top", (0, 0, height - thick), (0, 0, height), [width / 2] * 2, GREY, segments=40)
    else:
        width = float(rng.uniform(0.8, 1.2) if low else rng.uniform(0.9, 1.9))
        depth = float(rng.uniform(0.45, 0.7) if low else rng.uniform(0.6, 0.95))
        top = box("top", (0, 0, height - thick / 2), (width, depth, thick), GREY, bevel=0.008)
    parts = top_material.on([top])
    under = height - thick
    if round_ and rng.random() < 0.6:
        return parts + frame.on(_column(rng, under, width))
    if not round_ and rng.random() < 0.2:
        return parts + frame.on(_trestles(under, width, depth))
    reach = 0.34 if round_ else 0.46
    x, y = reach * width - 0.02, reach * depth - 0.02
    splay, thickness = float(rng.uniform(0, 0.06)), float(rng.uniform(0.03, 0.07))
    taper, round_legs = float(rng.uniform(0.5, 1.0)), bool(rng.random() < 0.5)
    legs = corner_legs("leg", (x, y), under, thickness, splay, taper, round_legs)
    if not round_ and rng.random() < 0.6:
        legs += [box("apron", (0, s * y, under - 0.045), (2 * x, 0.02, 0.09), GREY) for s in (-1, 1)]
        legs += [box("apron", (s * x, 0, under - 0.045), (0.02, 2 * y, 0.09), GREY) for s in (-1, 1)]
    parts += frame.on(legs)
    if low and not round_ and rng.random() < 0.5:
        parts += top_material.on([box("shelf", (0, 0, 0.14), (2 * x, 2 * y, 0.02), GREY)])
    return parts


def _column(rng: np.random.Generator, under: float, width: float) -> list[Part]:
    thick = float(rng.uniform(0.03, 0.07))
    foot = float(rng.uniform(0.28, 0.36)) * width
    radii = [foot, foot, 1.3 * thick, thick, thick, 1.6 * thick]
    places = [0, 0.02, 0.08, 0.2, 0.9, 1.0]
    return [tube("column", (0, 0, 0), (0, 0, under), radii, GREY, segments=24, positions=places)]


def _trestles(under: float, width: float, depth: float) -> list[Part]:
    parts = []
    for s in (-1, 1):
        x, y = s * 0.38 * width, 0.42 * depth
        for t in (-1, 1):
            parts.append(bar("leg", (x, 0.2 * t * y, under), (x, t * y, 0), 0.06, GREY, False))
        parts.append(box("trestle", (x, 0, 0.35 * under), (0.04, 1.2 * y, 0.05), GREY))
    ends = np.array([(-0.38 * width, 0, 0.35 * under), (0.38 * width, 0, 0.35 * under)])
    ring = np.array([(0, -0.02, -0.03), (0, 0.02, -0.03), (0, 0.02, 0.03), (0, -0.02, 0.03)])
    return [*parts, loft("beam", ends[:, None] + ring, GREY)]
