"""Floor, mirrors, doors, cladding, stripes, roof rack, and the load bed of a pickup."""

import numpy as np

from procedural.car_cabin import Cabin
from procedural.car_proportions import Proportions
from procedural.mesh import Colour, Part, both_sides, box, panel
from procedural.paint import CHROME, DARK_TRIM, CarPaint

UNDERBODY: Colour = (0.10, 0.10, 0.105)


def underbody(p: Proportions) -> list[Part]:
    """Floor and engine bay: closes the wheel arches' tunnel and shows as a dark belly from below."""
    low, high = p.clearance - 0.03, p.wheel + 0.22
    size = (2 * p.half_width - 0.56, p.length - 0.36, high - low)
    return [box("underbody", (0, 0, (low + high) / 2), size, UNDERBODY, bevel=0.03)]


def trim(p: Proportions, paint: CarPaint, rng: np.random.Generator) -> list[Part]:
    """Mirrors, door gaps and handles, sill cladding, bonnet stripe, roof rack."""
    c = Cabin(p)
    side = p.half_width
    mirror_y = p.cowl + 0.32 * p.front_rake + 0.10
    mirror_colour = paint.body if rng.random() < 0.6 else DARK_TRIM
    place = (side + 0.05, mirror_y, p.belt + 0.07)
    parts = both_sides(box("mirror", place, (0.20, 0.10, 0.13), mirror_colour, bevel=0.03))

    doors = [p.cowl + 0.22, p.cowl + 0.22 + float(rng.uniform(1.0, 1.15))]
    if p.side_windows > 1:
        doors.append(min(doors[-1] + 0.85, p.rear_axle - 0.15))
    low, high = p.clearance + 0.10, p.belt - 0.10
    for k, y in enumerate(doors):
        if p.front_axle + 1.15 * p.wheel < y < p.rear_axle - 0.9 * p.wheel:
            gap = box("door_gap", (side - 0.014, y, (low + high) / 2), (0.03, 0.016, high - low), DARK_TRIM)
            parts += both_sides(gap)
        if k > 0:
            handle = (side - 0.005, y - 0.16, high - 0.06)
            parts += both_sides(box("handle", handle, (0.04, 0.15, 0.035), CHROME))
    if paint.cladding is not None:
        start, stop = p.front_axle + 1.16 * p.wheel, p.rear_axle - 1.16 * p.wheel
        tall = 0.30 * (p.belt - p.clearance)
        place = (side - 0.02, (start + stop) / 2, p.clearance + 0.02 + tall / 2)
        parts += both_sides(box("cladding", place, (0.06, stop - start, tall), paint.cladding, bevel=0.02))
    if paint.stripe is not None:
        parts += _stripes(p, c, paint.stripe)
    if p.style in ("wagon", "suv") and rng.random() < 0.55:
        parts += _roof_rack(c, rng)
    return parts


def _stripes(p: Proportions, c: Cabin, colour: Colour) -> list[Part]:
    """Two stripes over bonnet and roof."""
    parts: list[Part] = []
    y0, y1 = p.front + 0.14, p.cowl
    bonnet = [(0.08, y0, p.nose), (0.26, y0, p.nose), (0.26, y1, p.belt), (0.08, y1, p.belt)]
    parts += both_sides(panel("stripe", np.array(bonnet), colour, "paint", proud=0.008))
    a, b, z = c.front(1.0) + 0.14, c.rear(1.0) - 0.14, c.z(1.0)
    if b - a > 0.2:
        roof = [(0.08, a, z), (0.26, a, z), (0.26, b, z), (0.08, b, z)]
        parts += both_sides(panel("stripe", np.array(roof), colour, "paint", proud=0.008))
    return parts


def _roof_rack(c: Cabin, rng: np.random.Generator) -> list[Part]:
    a, b = c.front(1.0) + 0.2, c.rear(1.0) - 0.15
    colour = DARK_TRIM if rng.random() < 0.5 else CHROME
    x, z = c.half(1.0) - 0.14, c.z(1.0) + 0.035
    parts = both_sides(box("roof_rack", (x, (a + b) / 2, z), (0.05, b - a, 0.09), colour, bevel=0.015))
    if rng.random() < 0.5:
        for f in (0.25, 0.75):
            parts.append(box("roof_rack", (0, a + f * (b - a), z + 0.03), (2 * x, 0.06, 0.03), colour))
    return parts


def pickup_bed(p: Proportions, paint: CarPaint) -> list[Part]:
    """The open load bed: side walls, tailgate, and a dark floor."""
    start, stop = p.cabin_rear - 0.05, p.rear - 0.01
    low, high = p.bed_floor - 0.14, p.belt - 0.01
    half = p.half_width_at((start + stop) / 2) - 0.012
    wall = box(
        "bed_wall",
        (half - 0.05, (start + stop) / 2, (low + high) / 2),
        (0.10, stop - start, high - low),
        paint.body,
        "paint",
        bevel=0.02,
    )
    gate_half = p.half_width_at(p.rear)
    gate = (0, stop - 0.05, (low + high) / 2)
    tailgate = box("tailgate", gate, (2 * gate_half, 0.10, high - low), paint.body, "paint", bevel=0.02)
    floor = box(
        "bed_floor",
        (0, (p.cabin_rear + stop) / 2, p.bed_floor),
        (2 * half - 0.20, stop - p.cabin_rear - 0.06, 0.03),
        UNDERBODY,
    )
    return [*both_sides(wall), tailgate, floor]
