"""Open shelves with books and things on them; cabinets, chests of drawers, sideboards."""

from itertools import pairwise

import numpy as np

from procedural.chair_parts import FABRICS, bar, draw_colour
from procedural.mesh import Part, box, tube
from procedural.products.materials import ceramic, metal, wood
from procedural.products.pieces import GREY, corner_legs


def shelf(rng: np.random.Generator) -> list[Part]:
    """Boards between sides or on a metal frame, some of them with books, vases or boxes."""
    width, depth = float(rng.uniform(0.5, 1.1)), float(rng.uniform(0.26, 0.38))
    height, levels = float(rng.uniform(0.8, 1.9)), int(rng.integers(3, 6))
    thick, boards = 0.025, wood(rng)
    open_frame = rng.random() < 0.45
    first = float(rng.uniform(0.06, 0.15))
    heights = np.linspace(first, height - thick / 2, levels)
    inner = width - 0.05
    planks = [box("board", (0, 0, z), (inner if not open_frame else width, depth, thick), GREY) for z in heights]
    parts = boards.on(planks)
    if open_frame:
        reach = (width / 2 - 0.015, depth / 2 - 0.015)
        posts = corner_legs("post", reach, height + 0.04, 0.03, 0, 1.0, False)
        parts += metal(rng).on(posts)
    else:
        sides = [box("side", (s * (width - thick) / 2, 0, height / 2), (thick, depth, height), GREY) for s in (-1, 1)]
        parts += boards.on(sides)
        if rng.random() < 0.5:
            parts += boards.on([box("rear", (0, depth / 2 - 0.008, height / 2), (inner, 0.012, height - 0.02), GREY)])
    for low, high in pairwise(heights):
        if rng.random() < 0.75:
            parts += _content(rng, inner - 0.08, depth, low + thick / 2, high - low - thick)
    return parts


def _content(rng: np.random.Generator, width: float, depth: float, floor: float, room: float) -> list[Part]:
    """A row of books, with a vase or a box beside it."""
    parts, x = [], -width / 2
    stop = x + width * float(rng.uniform(0.3, 0.95))
    while x < stop - 0.04:
        thick, tall = float(rng.uniform(0.025, 0.055)), room * float(rng.uniform(0.6, 0.88))
        deep = depth * float(rng.uniform(0.6, 0.8))
        colour = draw_colour(rng, FABRICS)
        parts.append(
            box(
                "book",
                (x + thick / 2, (depth - deep) / 2 - 0.03, floor + tall / 2),
                (thick - 0.003, deep, tall),
                colour,
            )
        )
        x += thick
    if width / 2 - x > 0.16:
        middle, size = (x + width / 2) / 2, min(0.08, 0.3 * room)
        if rng.random() < 0.5:
            radii = [0.6 * size, size, 0.9 * size, 0.4 * size, 0.5 * size]
            vase = tube("vase", (middle, 0, floor), (middle, 0, floor + 0.75 * room), radii, GREY, segments=20)
            parts += ceramic(rng).on([vase])
        else:
            parts += wood(rng).on(
                [box("box", (middle, 0, floor + 0.25 * room), (2 * size, 0.6 * depth, 0.5 * room), GREY)]
            )
    return parts


def cabinet(rng: np.random.Generator) -> list[Part]:
    """A body on legs or a plinth whose front, at −y, is a grid of drawers and doors with handles."""
    width, depth = float(rng.uniform(0.45, 1.5)), float(rng.uniform(0.36, 0.48))
    leg = float(rng.uniform(0.03, 0.22))
    tall = float(rng.uniform(0.45, 1.15)) if width < 1.0 else float(rng.uniform(0.45, 0.75))
    body_material = wood(rng)
    front_material = body_material if rng.random() < 0.55 else wood(rng)
    handle = metal(rng)
    middle = leg + tall / 2
    parts = body_material.on([box("body", (0, 0, middle), (width, depth, tall), GREY, bevel=0.006)])
    if rng.random() < 0.6:
        parts += body_material.on(
            [box("top", (0, -0.01, leg + tall + 0.012), (width + 0.03, depth + 0.03, 0.025), GREY)]
        )
    columns = max(1, round(width / float(rng.uniform(0.42, 0.60))))
    fronts, handles, y = [], [], -depth / 2
    for c in range(columns):
        across = (width - 0.03) / columns
        x = -(width - 0.03) / 2 + (c + 0.5) * across
        door = rng.random() < 0.45
        rows = 1 if door else max(2, round(tall / float(rng.uniform(0.18, 0.26))))
        for r in range(rows):
            high = (tall - 0.03) / rows
            z = leg + 0.015 + (r + 0.5) * high
            fronts.append(box("front", (x, y - 0.006, z), (across - 0.014, 0.02, high - 0.014), GREY, bevel=0.004))
            if door:
                side = x + (0.38 if c < columns / 2 else -0.38) * across
                handles.append(bar("handle", (side, y - 0.035, z - 0.07), (side, y - 0.035, z + 0.07), 0.018, GREY))
            elif across > 0.5:
                handles.append(bar("handle", (x - 0.08, y - 0.035, z), (x + 0.08, y - 0.035, z), 0.018, GREY))
            else:
                handles.append(tube("knob", (x, y, z), (x, y - 0.045, z), [0.008, 0.02, 0.02], GREY, segments=12))
    parts += front_material.on(fronts) + handle.on(handles)
    legs = corner_legs("leg", (width / 2 - 0.05, depth / 2 - 0.05), leg + 0.01, 0.04, 0.01, 0.6)
    return parts + (body_material if rng.random() < 0.6 else handle).on(legs)
