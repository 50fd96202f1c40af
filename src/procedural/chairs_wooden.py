"""Chairs made of bars and boards: dining chairs, Windsor chairs, bar stools with a low back."""

import numpy as np

from procedural.chair_parts import (
    FABRICS,
    METALS,
    WOODS,
    Seat,
    bar,
    draw_colour,
    draw_seat,
    four_legs,
    post_arms,
    sheet,
    stretchers,
)
from procedural.mesh import Colour, Part, box, loft, tube


def dining(rng: np.random.Generator) -> list[Part]:
    """Four legs, the rear ones carrying a back of slats, rungs, a cross, a board or a pad."""
    seat = draw_seat(rng)
    wood, fabric = draw_colour(rng, WOODS), draw_colour(rng, FABRICS)
    round_ = bool(rng.random() < 0.35)
    thick = float(rng.uniform(0.030, 0.050))
    x, front, rear = seat.width / 2 - thick / 2, seat.front + thick / 2, seat.rear - thick / 2
    taper, rake = float(rng.uniform(0.6, 1.0)), float(rng.uniform(0.0, 0.06))
    parts: list[Part] = []
    for s in (-1, 1):
        parts.append(bar("leg", (s * x, front, seat.height), (s * x, front, 0), thick, wood, round_, taper))
        parts.append(bar("leg", (s * x, rear, seat.height), (s * x, rear + rake, 0), thick, wood, round_, taper))
        top = (s * x, rear + seat.lean, seat.top)
        parts.append(bar("back_post", (s * x, rear, seat.height - 0.03), top, thick, wood, round_, 0.8))
    board = (seat.width + 0.01, seat.depth + 0.01, 0.035)
    parts.append(box("seat", (0, 0, seat.height), board, wood, bevel=0.012))
    if rng.random() < 0.5:
        size = (seat.width - 0.03, seat.depth - 0.05, 0.05)
        parts.append(box("cushion", (0, -0.01, seat.height + 0.035), size, fabric, bevel=0.022))
    if rng.random() < 0.6:
        parts += _apron(seat, wood, x, rear)
    if rng.random() < 0.5:
        parts += stretchers(seat, rng, wood, round_)
    if rng.random() < 0.28:
        parts += post_arms(seat, rng, wood, round_)
    kind = ("slats", "rungs", "board", "cross", "pad")[int(rng.integers(5))]
    return parts + _back(kind, seat, rng, wood, fabric, rear, x, round_)


def _apron(seat: Seat, wood: Colour, x: float, rear: float) -> list[Part]:
    z, tall = seat.height - 0.045, 0.06
    sides = [box("apron", (s * x, 0, z), (0.02, 2 * rear, tall), wood) for s in (-1, 1)]
    return [*sides, *(box("apron", (0, s * rear, z), (2 * x, 0.02, tall), wood) for s in (-1, 1))]


def _back(
    kind: str,
    seat: Seat,
    rng: np.random.Generator,
    wood: Colour,
    fabric: Colour,
    rear: float,
    x: float,
    round_: bool,
) -> list[Part]:
    """Build the back between the two rear posts."""

    def y(z: float) -> float:
        return rear + seat.lean * (z - seat.height) / (seat.top - seat.height)

    def rail(name: str, z: float, tall: float, colour: Colour = wood, thick: float = 0.022) -> Part:
        return _leaning_board(name, x, (y(z - tall / 2), z - tall / 2), (y(z + tall / 2), z + tall / 2), thick, colour)

    crest = float(rng.uniform(0.05, 0.11))
    parts = [rail("crest", seat.top - crest / 2 + 0.01, crest, thick=0.026)]
    low = seat.height + float(rng.uniform(0.06, 0.18))
    high = seat.top - crest
    if kind == "slats":
        parts.append(rail("back_rail", low, 0.035))
        for sx in np.linspace(-1, 1, int(rng.integers(3, 7)) + 2)[1:-1] * x:
            parts.append(bar("slat", (sx, y(low), low), (sx, y(high), high), 0.024, wood, round_))
    elif kind == "rungs":
        count = int(rng.integers(2, 5))
        for z in np.linspace(low, high - 0.03, count + 1)[:count]:
            parts.append(rail("rung", z, 0.045))
    elif kind == "cross":
        parts.append(rail("back_rail", low, 0.035))
        for s in (-1, 1):
            parts.append(bar("cross", (s * x, y(low), low), (-s * x, y(high), high), 0.028, wood, round_))
    elif kind == "board":
        middle, tall = (low + high) / 2, high - low + 0.01
        parts.append(rail("back_board", middle, tall, thick=0.016))
    else:
        middle, tall = (low + high) / 2, high - low + 0.01
        parts.append(rail("back_pad", middle, tall, fabric, thick=0.055))
    return parts


def _leaning_board(
    name: str, x: float, low: tuple[float, float], high: tuple[float, float], thick: float, colour: Colour
) -> Part:
    """A flat board across the back between two heights, (y, z) each."""
    rings = []
    for y, z in (low, high):
        a, b = y - thick / 2, y + thick / 2
        rings.append([(-x, a, z), (x, a, z), (x, b, z), (-x, b, z)])
    return loft(name, np.array(rings), colour)


def windsor(rng: np.random.Generator) -> list[Part]:
    """Splayed round legs, a broad board, many spindles up to a curved crest."""
    seat = draw_seat(rng, depth=(0.40, 0.46), width=(0.42, 0.52), top=(0.82, 1.10), lean=(0.08, 0.18))
    wood = draw_colour(rng, WOODS)
    board_colour = wood if rng.random() < 0.7 else draw_colour(rng, WOODS)
    splay = float(rng.uniform(0.03, 0.08))
    parts = four_legs(seat, rng, wood, splay, seat.height, True)
    parts += stretchers(seat, rng, wood, True, splay)
    cut, w, d = float(rng.uniform(0.06, 0.12)), seat.width / 2, seat.depth / 2
    outline = [(-w + cut, -d), (w - cut, -d), (w, -d + cut), (w, d - 1.5 * cut), (w - 1.5 * cut, d)]
    outline += [(-w + 1.5 * cut, d), (-w, d - 1.5 * cut), (-w, -d + cut)]
    levels = [(-0.020, 0.97), (-0.005, 1.0), (0.014, 1.0), (0.022, 0.96)]
    rings = [[(s * px, s * py, seat.height + z) for px, py in outline] for z, s in levels]
    parts.append(loft("seat", np.array(rings), board_colour))

    count, bow = int(rng.integers(5, 10)), float(rng.uniform(0.05, 0.10))
    fan = float(rng.uniform(0.90, 1.08))
    for t in np.linspace(-1, 1, count):
        foot = (0.86 * t * w, d - 0.03 - bow * t**2, seat.height)
        head = (fan * 0.86 * t * w, d - 0.03 + seat.lean - bow * t**2, seat.top - 0.03)
        parts.append(bar("spindle", foot, head, 0.020 if abs(t) < 1 else 0.030, wood))
    tall, half = float(rng.uniform(0.05, 0.10)), fan * 0.90 * w
    y = d - 0.03 + seat.lean
    path = [(y - 0.006, seat.top - tall), (y + 0.006, seat.top)]
    # The sheet's raised edges point to −y here, the way the spindles bow.
    parts.append(sheet("crest", path, [half, 0.92 * half], 0.022, wood, bowl=bow))
    if rng.random() < 0.4:
        parts += post_arms(Seat(seat.width, seat.depth, seat.height, seat.top, 0.3 * seat.lean), rng, wood, True)
    return parts


def bar_stool(rng: np.random.Generator) -> list[Part]:
    """A high seat with a foot rest and a low back, on four legs or a round plate."""
    height = float(rng.uniform(0.62, 0.78))
    seat = draw_seat(
        rng,
        width=(0.36, 0.44),
        depth=(0.34, 0.42),
        height=(height, height),
        top=(height + 0.16, height + 0.36),
        lean=(0.03, 0.08),
    )
    fabric = draw_colour(rng, FABRICS)
    if rng.random() < 0.65:
        metallic = rng.random() < 0.4
        frame = draw_colour(rng, METALS if metallic else WOODS)
        splay, round_ = float(rng.uniform(0.02, 0.07)), bool(rng.random() < 0.5)
        parts = four_legs(seat, rng, frame, splay, height, round_)
        z = float(rng.uniform(0.20, 0.28))
        parts += stretchers(seat, rng, frame, round_, splay, z)
        y = seat.depth / 2 - 0.02
        parts.append(bar("foot_rest", (-seat.width / 2, -y, z), (seat.width / 2, -y, z), 0.026, frame, round_))
    else:
        frame = draw_colour(rng, METALS)
        plate = float(rng.uniform(0.19, 0.23))
        parts = [tube("base", (0, 0, 0), (0, 0, 0.03), [plate, plate, 0.04], frame, "paint", 20, [0, 0.4, 1])]
        parts.append(tube("column", (0, 0, 0.02), (0, 0, height), [0.028, 0.028], frame, "paint"))
        parts.append(bar("foot_rest", (0, 0, 0.28), (0, -0.20, 0.28), 0.022, frame))
        parts.append(bar("foot_rest", (-0.14, -0.20, 0.28), (0.14, -0.20, 0.28), 0.022, frame))
    thick = float(rng.uniform(0.04, 0.09))
    parts.append(box("seat", (0, 0, height), (seat.width, seat.depth, thick), fabric, bevel=0.02))
    for s in (-1, 1):
        x = s * 0.36 * seat.width
        parts.append(
            bar("back_post", (x, seat.rear - 0.02, height), (x, seat.rear + seat.lean, seat.top), 0.024, frame)
        )
    tall = 0.55 * (seat.top - height)
    path = [(seat.back_at(z), z) for z in (seat.top - tall, seat.top - tall / 2, seat.top)]
    parts.append(sheet("back", path, [seat.width / 2] * 3, 0.035, fabric, bowl=float(rng.uniform(0.0, 0.07))))
    return parts
