"""Parts that tell a car's front from its back: lights, grille, bumpers, plates, spoiler."""

import numpy as np

from procedural.car_proportions import Proportions
from procedural.mesh import Colour, Part, both_sides, box, tube
from procedural.paint import CHROME, DARK_TRIM, CarPaint

HEADLIGHT: Colour = (0.93, 0.94, 0.88)
TAIL_LIGHT: Colour = (0.82, 0.03, 0.05)
INDICATOR: Colour = (0.95, 0.50, 0.08)
PLATE: Colour = (0.93, 0.92, 0.85)


def front_end(p: Proportions, paint: CarPaint, rng: np.random.Generator) -> list[Part]:
    """Headlights, grille, bumper, number plate, indicators: the face of the car, at −y."""
    half, nose = p.half_width_at(p.front), p.nose - 0.05
    band = float(np.clip(0.33 * (nose - p.clearance), 0.13, 0.26)) * float(rng.uniform(0.8, 1.1))
    z = nose - 0.05 - band / 2
    width = float(rng.uniform(0.28, 0.42)) * half
    parts: list[Part] = []
    x = half - width / 2 + 0.012
    if rng.random() < 0.2:
        start, r = np.array([x - 0.02, p.front - 0.02, z]), 0.62 * band
        parts += both_sides(
            tube("headlight", start, start + np.array([0, 0.14, 0]), [0.85 * r, r, r], HEADLIGHT, "glass")
        )
    else:
        size = (width, 0.24, band)
        parts += both_sides(box("headlight", (x, p.front + 0.10, z), size, HEADLIGHT, "glass", bevel=0.02))
        if rng.random() < 0.6:
            size = (0.06, 0.22, 0.8 * band)
            place = (half + 0.012, p.front + 0.125, z)
            parts += both_sides(box("indicator", place, size, INDICATOR, "glass"))
    grille_half = (half - width - 0.03) * float(rng.uniform(0.7, 1.0))
    grille_z = z - float(rng.uniform(0.0, 0.06))
    grille = box("grille", (0, p.front + 0.03, grille_z), (2 * grille_half, 0.10, band * 0.95), DARK_TRIM, bevel=0.015)
    parts.append(grille)
    if rng.random() < 0.5:
        for dz in (-0.2, 0.2):
            place = (0, p.front + 0.02, grille_z + dz * band)
            parts.append(box("grille_bar", place, (1.9 * grille_half, 0.10, 0.02), CHROME))
    low, high = p.clearance + 0.02, z - band / 2 - 0.03
    parts.append(_bumper("front_bumper", p, paint, low, high, front=True))
    plate_z = (low + high) / 2
    parts.append(box("plate", (0, p.front - 0.065, plate_z), (0.50, 0.02, 0.11), PLATE))
    if paint.bumpers == paint.body:
        size = (1.1 * half, 0.03, 0.35 * (high - low))
        parts.append(box("intake", (0, p.front - 0.053, low + 0.2 * (high - low)), size, DARK_TRIM))
    return parts


def _bumper(name: str, p: Proportions, paint: CarPaint, low: float, high: float, front: bool) -> Part:
    sign, end = (-1, p.front) if front else (1, p.rear)
    half = p.half_width_at(end) + 0.035
    y = end - sign * 0.08
    size = (2 * half, 0.28, high - low)
    finish = "paint" if paint.bumpers == paint.body else "matte"
    return box(name, (0, y, (low + high) / 2), size, paint.bumpers, finish, bevel=0.045)


def rear_end(p: Proportions, paint: CarPaint, rng: np.random.Generator) -> list[Part]:
    """Red tail lights, bumper, plate, exhaust and perhaps a spoiler, at +y."""
    half = p.half_width_at(p.rear)
    tail = p.belt if p.style == "pickup" else p.deck
    parts: list[Part] = []
    upright = p.style in ("suv", "van", "pickup", "wagon") or (p.style == "hatchback" and rng.random() < 0.5)
    if upright:
        tall, wide = (tail - p.clearance) * float(rng.uniform(0.30, 0.42)), float(rng.uniform(0.14, 0.20))
    else:
        tall, wide = float(rng.uniform(0.12, 0.18)), float(rng.uniform(0.32, 0.50))
    z = tail - 0.07 - tall / 2
    place = (half - wide / 2 + 0.014, p.rear - 0.10, z)
    parts += both_sides(box("tail_light", place, (wide, 0.24, tall), TAIL_LIGHT, "glass", bevel=0.02))
    # A dark frame keeps red lights apart from red paint; the pale reversing lamp sits inside.
    frame = (place[0] - 0.012, place[1] - 0.01, z)
    parts += both_sides(box("tail_frame", frame, (wide + 0.05, 0.235, tall + 0.06), DARK_TRIM, bevel=0.02))
    lamp = (place[0] - wide / 4, p.rear + 0.012, z - (0.22 * tall if upright else 0))
    size = (wide / 2.2, 0.03, tall / 3 if upright else tall / 2)
    parts += both_sides(box("reversing_lamp", lamp, size, HEADLIGHT, "glass"))
    if not upright and rng.random() < 0.3:
        parts.append(box("tail_band", (0, p.rear - 0.02, z), (2 * half - 2 * wide, 0.06, 0.4 * tall), TAIL_LIGHT))
    low, high = p.clearance + 0.04, min(z - tall / 2 - 0.02, p.clearance + 0.36)
    parts.append(_bumper("rear_bumper", p, paint, low, high, front=False))
    plate_z = max(z - tall / 2, high + 0.09) if upright else high + 0.08
    parts.append(box("plate", (0, p.rear + 0.005, plate_z), (0.50, 0.03, 0.12), PLATE))
    pipe_x, pipe = float(rng.uniform(0.3, 0.6)) * half, np.array([0.0, 0.26, 0.0])
    start = np.array([pipe_x, p.rear - 0.18, p.clearance + 0.02])
    exhaust = tube("exhaust", start, start + pipe, [0.04, 0.04], CHROME, segments=8)
    parts += both_sides(exhaust) if rng.random() < 0.4 else [exhaust]
    parts += _spoiler(p, paint, rng)
    return parts


def _spoiler(p: Proportions, paint: CarPaint, rng: np.random.Generator) -> list[Part]:
    chance = {"sports": 0.6, "sedan": 0.10, "hatchback": 0.35, "suv": 0.25}.get(p.style, 0.0)
    if rng.random() >= chance:
        return []
    colour = paint.body if rng.random() < 0.7 else DARK_TRIM
    if p.style in ("hatchback", "suv"):
        y = p.cabin_rear - p.rear_rake
        place = (0, y + 0.05, p.height - 0.05)
        return [box("spoiler", place, (1.7 * (p.half_width - p.tumblehome - 0.1), 0.26, 0.05), colour, bevel=0.02)]
    height, width = float(rng.uniform(0.08, 0.22)), 1.7 * p.half_width
    y = p.rear - 0.16
    wing = box("spoiler", (0, y, p.deck + height), (width, 0.24, 0.04), colour, "paint", bevel=0.015)
    post = box("spoiler_post", (0.36 * width, y, p.deck + height / 2 - 0.02), (0.05, 0.12, height), DARK_TRIM)
    return [wing, *both_sides(post)]
