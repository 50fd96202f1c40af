"""Upholstered, office, moulded and tubular chairs."""

import numpy as np
from jaxtyping import Float

from procedural.chair_parts import (
    FABRICS,
    METALS,
    WOODS,
    Seat,
    bar,
    draw_colour,
    draw_seat,
    four_legs,
    pipe,
    sheet,
    smooth_path,
    star_base,
)
from procedural.mesh import Colour, Part, box, tube


def _leaning_cushion(
    name: str, y: float, low: float, high: float, lean: float, width: float, thick: float, colour: Colour
) -> Part:
    """A thick bevelled cushion from height `low` to `high`, its front face starting at `y`."""
    cushion = box(name, (0, 0, 0), (width, thick, high - low), colour, bevel=min(0.05, 0.35 * thick))
    v = cushion.vertices
    v[:, 1] += lean * (v[:, 2] / (high - low) + 0.5)
    return Part(name, v + np.array([0, y + thick / 2, (low + high) / 2]), cushion.faces, colour)


def armchair(rng: np.random.Generator) -> list[Part]:
    """A deep upholstered chair: base, arms, back, loose cushions, short feet, perhaps wings."""
    seat = draw_seat(
        rng, width=(0.50, 0.64), depth=(0.54, 0.68), height=(0.38, 0.46), top=(0.72, 1.05), lean=(0.04, 0.16)
    )
    fabric = draw_colour(rng, FABRICS)
    cushion = fabric if rng.random() < 0.6 else draw_colour(rng, FABRICS)
    foot_colour = draw_colour(rng, WOODS)
    arm, back, foot = float(rng.uniform(0.09, 0.18)), float(rng.uniform(0.14, 0.22)), float(rng.uniform(0.04, 0.16))
    arm_top = seat.height + float(rng.uniform(0.12, 0.24))
    full, base_top = seat.width + 2 * arm, seat.height - 0.10
    base_size = (seat.width + 0.02, seat.depth + back, base_top - foot)
    cushion_size = (seat.width - 0.01, seat.depth + 0.01, 0.15)
    parts = [
        box("base", (0, back / 2, (foot + base_top) / 2), base_size, fabric, bevel=0.02),
        box("cushion", (0, -0.01, base_top + 0.07), cushion_size, cushion, bevel=0.045),
    ]
    parts.append(_leaning_cushion("back", seat.rear - 0.02, foot, seat.top, seat.lean, full - 0.6 * arm, back, fabric))
    open_arms = rng.random() < 0.25
    for s in (-1, 1):
        x = s * (seat.width / 2 + arm / 2)
        if open_arms:
            y0, y1 = seat.front + 0.05, seat.rear + 0.02
            parts.append(box("arm", (x, 0, arm_top), (0.07, seat.depth, 0.04), foot_colour, bevel=0.015))
            parts.append(bar("arm_post", (x, y0, foot), (x, y0, arm_top), 0.04, foot_colour, False))
            parts.append(bar("arm_post", (x, y1, foot), (x, y1, arm_top), 0.04, foot_colour, False))
        else:
            size = (arm, seat.depth + 0.6 * back, arm_top - foot)
            parts.append(box("arm", (x, 0.3 * back, (foot + arm_top) / 2), size, fabric, bevel=0.04))
    if rng.random() < 0.5:
        low, high = seat.height + 0.04, seat.top - float(rng.uniform(0.02, 0.10))
        y = seat.rear - 0.10 + 0.25 * seat.lean
        parts.append(_leaning_cushion("back_cushion", y, low, high, 0.8 * seat.lean, seat.width - 0.02, 0.13, cushion))
    if seat.top > 0.88 and rng.random() < 0.5:
        for s in (-1, 1):
            place = (s * (full / 2 - 0.30 * arm - 0.03), seat.rear + 0.5 * seat.lean - 0.06, (arm_top + seat.top) / 2)
            parts.append(box("wing", place, (0.07, 0.24, seat.top - arm_top - 0.02), fabric, bevel=0.025))
    for x in (-1, 1):
        for y in (seat.front + 0.05, seat.rear + back - 0.05):
            top = (x * (full / 2 - 0.07), y, foot + 0.02)
            if open_arms:
                top = (x * (seat.width / 2 - 0.04), y, foot + 0.02)
            parts.append(bar("leg", top, (top[0] + 0.01 * x, y, 0), 0.05, foot_colour, taper=0.7))
    return parts


def office(rng: np.random.Generator) -> list[Part]:
    """Swivel chair on a five-spoke base, with a curved back and often arm rests."""
    seat = draw_seat(
        rng, width=(0.46, 0.54), depth=(0.44, 0.52), height=(0.44, 0.54), top=(0.86, 1.22), lean=(0.05, 0.14)
    )
    metal, fabric = draw_colour(rng, METALS), draw_colour(rng, FABRICS)
    back_colour = fabric if rng.random() < 0.75 else (0.12, 0.12, 0.13)
    thick = float(rng.uniform(0.06, 0.10))
    parts = star_base(rng, metal, seat.height, float(rng.uniform(0.28, 0.34)))
    parts.append(box("seat", (0, 0, seat.height), (seat.width, seat.depth, thick), fabric, bevel=0.03))
    parts.append(box("mechanism", (0, 0, seat.height - thick / 2 - 0.02), (0.18, 0.24, 0.05), (0.1, 0.1, 0.105)))
    low = seat.height + float(rng.uniform(0.06, 0.14))
    profile = [(seat.back_at(low) - 0.01, low), (seat.back_at(low + 0.12) - 0.04, low + 0.14)]
    profile += [
        (seat.back_at(0.5 * (low + seat.top)) - 0.01, 0.5 * (low + seat.top)),
        (seat.back_at(seat.top), seat.top),
    ]
    path = smooth_path(profile)
    t = np.linspace(0, 1, len(path))
    widths = 0.5 * seat.width * np.interp(t, [0, 0.25, 0.8, 1], [0.82, 0.98, 0.92, rng.uniform(0.6, 0.9)])
    bowl = float(rng.uniform(0.02, 0.07))
    parts.append(sheet("back", path, widths, float(rng.uniform(0.03, 0.07)), back_colour, bowl=bowl))
    spine = [(0, 0.10, seat.height - thick / 2 - 0.02), (0, seat.rear + 0.07, seat.height - 0.04)]
    spine.append((0, seat.back_at(low + 0.15) + 0.03, low + 0.18))
    parts += pipe("spine", spine, 0.045, metal)
    if rng.random() < 0.3:
        z = seat.top + 0.09
        parts.append(
            bar("neck", (0, seat.back_at(seat.top), seat.top - 0.1), (0, seat.back_at(z) + 0.01, z), 0.03, metal)
        )
        parts.append(box("headrest", (0, seat.back_at(z) - 0.01, z), (0.28, 0.06, 0.13), back_colour, bevel=0.02))
    if rng.random() < 0.7:
        parts += _t_arms(seat, rng, metal)
    return parts


def _t_arms(seat: Seat, rng: np.random.Generator, metal: Colour) -> list[Part]:
    z, x = seat.height + float(rng.uniform(0.18, 0.25)), seat.width / 2 + 0.035
    parts = []
    for s in (-1, 1):
        points = [(s * 0.5 * seat.width * 0.8, 0.04, seat.height - 0.03), (s * x, 0.04, seat.height - 0.03)]
        parts += pipe("arm_post", [*points, (s * x, 0.04, z)], 0.032, metal)
        place = (s * x, 0.0, z + 0.01)
        parts.append(box("arm", place, (0.07, 0.27, 0.03), (0.11, 0.11, 0.12), bevel=0.012))
    return parts


def shell(rng: np.random.Generator) -> list[Part]:
    """One moulded sheet for seat and back, on dowels, a pedestal or a sled."""
    seat = draw_seat(
        rng, width=(0.44, 0.56), depth=(0.42, 0.50), height=(0.42, 0.47), top=(0.76, 0.94), lean=(0.06, 0.16)
    )
    colour = draw_colour(rng, FABRICS)
    colour = (0.92, 0.92, 0.91) if rng.random() < 0.2 else colour
    f, r, h = seat.front, seat.rear, seat.height
    profile = [(f - 0.01, h - 0.03), (f + 0.05, h + 0.005), (0.0, h - 0.015), (r - 0.08, h), (r, h + 0.10)]
    profile += [(seat.back_at((h + seat.top) / 2), (h + seat.top) / 2), (seat.back_at(seat.top), seat.top)]
    path = smooth_path(profile)
    t = np.linspace(0, 1, len(path))
    crown = float(rng.uniform(0.55, 0.92))
    widths = (
        0.5
        * seat.width
        * np.interp(t, [0, 0.1, 0.45, 0.62, 0.9, 1], [0.82, 0.94, 1, 1.0, 0.95 * crown + 0.05, 0.8 * crown])
    )
    bowl = float(rng.uniform(0.04, 0.11))
    parts = [sheet("seat", path, widths, 0.018, colour, bowl=bowl, finish="paint", columns=13)]
    if rng.random() < 0.35:
        parts.append(_shell_cushion(path, widths, bowl, draw_colour(rng, FABRICS)))
    kind = rng.random()
    if kind < 0.5:
        wooden = rng.random() < 0.7
        frame = draw_colour(rng, WOODS if wooden else METALS)
        parts += four_legs(seat, rng, frame, float(rng.uniform(0.04, 0.09)), h - 0.02, True)
        for y in (-0.12, 0.12):
            parts.append(bar("rail", (-0.19, y, h - 0.05), (0.19, y, h - 0.05), 0.025, frame))
    elif kind < 0.75:
        metal = colour if rng.random() < 0.5 else draw_colour(rng, METALS)
        plate = float(rng.uniform(0.22, 0.28))
        radii, places = [plate, plate, 0.06, 0.03, 0.035, 0.12], [0, 0.03, 0.12, 0.4, 0.85, 1]
        parts.append(tube("pedestal", (0, 0, 0), (0, 0, h - 0.01), radii, metal, "paint", 20, places))
    else:
        metal = draw_colour(rng, METALS)
        for s in (-1, 1):
            x = s * 0.40 * seat.width
            points = [(0.7 * x, f + 0.10, h - 0.02), (x, f + 0.05, 0.012), (x, r, 0.012), (0.7 * x, r - 0.10, h - 0.02)]
            parts += pipe("leg", points, 0.022, metal)
    return parts


def _shell_cushion(
    path: list[tuple[float, float]], widths: Float[np.ndarray, "rows"], bowl: float, colour: Colour
) -> Part:
    """A pad that lies in the hollow of a shell's seat and follows its curve."""
    first, last, share = 4, 14, 0.72
    lifted = [(y, z + 0.024) for y, z in path[first:last]]
    # A pad of `share` of the width meets a parabola of depth `bowl` at share² of its height.
    half_widths = share * widths[first:last]
    return sheet("cushion", lifted, half_widths, 0.022, colour, bowl=share**2 * bowl)


def cantilever(rng: np.random.Generator) -> list[Part]:
    """A bent tube that carries seat and back with no rear legs."""
    seat = draw_seat(rng, width=(0.44, 0.54), depth=(0.42, 0.50), top=(0.80, 0.98), lean=(0.06, 0.16))
    metal, fabric = draw_colour(rng, METALS), draw_colour(rng, FABRICS)
    x, f, r, h = seat.width / 2, seat.front, seat.rear, seat.height
    thick = float(rng.uniform(0.022, 0.032))
    ground = thick / 2
    parts: list[Part] = []
    arms = rng.random() < 0.45
    for s in (-1, 1):
        side = [(s * x, r - 0.02, ground), (s * x, f + 0.02, ground), (s * x, f, h - 0.03), (s * x, r - 0.02, h - 0.03)]
        side += [(s * x, seat.back_at(h + 0.08), h + 0.08), (s * x, seat.back_at(seat.top), seat.top)]
        parts += pipe("frame", side, thick, metal)
        if arms:
            z = h + 0.22
            parts += pipe(
                "arm_post", [(s * x, f, h - 0.03), (s * x, f + 0.02, z), (s * x, seat.back_at(z), z)], thick, metal
            )
            parts.append(
                box("arm", (s * x, (f + r) / 2 - 0.02, z + 0.015), (0.05, 0.7 * seat.depth, 0.025), fabric, bevel=0.01)
            )
    parts += pipe("frame", [(-x, r - 0.02, ground), (x, r - 0.02, ground)], thick, metal)
    pad, inner = float(rng.uniform(0.02, 0.07)), seat.width - thick
    parts.append(box("seat", (0, 0, h - 0.02), (inner, seat.depth, pad), fabric, bevel=0.35 * pad))
    low = h + float(rng.uniform(0.12, 0.24))
    path = [(seat.back_at(z) - 0.012, z) for z in np.linspace(low, seat.top - 0.01, 5)]
    parts.append(sheet("back", path, [inner / 2 + 0.01] * 5, 0.7 * pad, fabric, bowl=-float(rng.uniform(0.0, 0.03))))
    return parts
