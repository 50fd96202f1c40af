"""Table lamps, floor lamps and tripod lamps."""

import numpy as np

from procedural.chair_parts import FABRICS, bar, draw_colour
from procedural.mesh import Part, tube
from procedural.paint import jitter, pick
from procedural.products.materials import Material, ceramic, cloth, metal, wood
from procedural.products.pieces import GREY


def lamp(rng: np.random.Generator) -> list[Part]:
    """A foot, a stem and a shade of fabric or metal."""
    kind = pick(rng, {"table": 3, "floor": 2, "tripod": 1.5, "arm": 1.5})
    frame = metal(rng) if rng.random() < 0.6 else wood(rng)
    pale = jitter(rng, (0.90, 0.86, 0.76)) if rng.random() < 0.6 else draw_colour(rng, FABRICS)
    shade = Material(pale, "matte", cloth(rng, pale) if rng.random() < 0.5 else None)
    if kind == "table":
        return _table_lamp(rng, shade)
    if kind == "arm":
        return _arm_lamp(rng, metal(rng), metal(rng))
    height = float(rng.uniform(1.25, 1.6))
    if kind == "floor":
        foot = float(rng.uniform(0.13, 0.18))
        radii, places = [foot, foot, 0.3 * foot, 0.012, 0.012], [0, 0.015, 0.025, 0.03, 1]
        parts = frame.on([tube("stem", (0, 0, 0), (0, 0, height), radii, GREY, segments=20, positions=places)])
    else:
        spread, turn = float(rng.uniform(0.25, 0.34)), float(rng.uniform(0, 2 * np.pi))
        legs = []
        for k in range(3):
            angle = turn + 2 * np.pi * k / 3
            foot_at = (spread * np.cos(angle), spread * np.sin(angle), 0)
            legs.append(bar("leg", (0, 0, height - 0.1), foot_at, 0.03, GREY, taper=0.8))
        hub = tube("hub", (0, 0, height - 0.13), (0, 0, height), [0.035, 0.035], GREY, segments=16)
        parts = frame.on([*legs, hub])
    return parts + shade.on([_shade(rng, height, float(rng.uniform(0.16, 0.25)))])


def _table_lamp(rng: np.random.Generator, shade: Material) -> list[Part]:
    base, tall = float(rng.uniform(0.06, 0.11)), float(rng.uniform(0.22, 0.36))
    profile = {
        "gourd": [0.7, 1.0, 1.05, 0.75, 0.45, 0.6, 0.5, 0.2],
        "ball": [0.6, 0.85, 1.1, 1.15, 1.0, 0.6, 0.25, 0.2],
        "column": [1.0, 1.0, 0.5, 0.45, 0.45, 0.45, 0.5, 0.3],
        "jar": [0.6, 0.8, 0.95, 1.05, 1.1, 0.95, 0.5, 0.3],
    }
    radii = [base * r for r in profile[list(profile)[rng.integers(len(profile))]]]
    body = tube("base", (0, 0, 0), (0, 0, tall), radii, GREY, segments=28)
    stem = tube("stem", (0, 0, tall - 0.01), (0, 0, tall + 0.10), [0.012, 0.012], GREY)
    parts = ceramic(rng).on([body]) + metal(rng).on([stem])
    return parts + shade.on([_shade(rng, tall + 0.10, base * float(rng.uniform(1.5, 2.0)))])


def _arm_lamp(rng: np.random.Generator, frame: Material, head: Material) -> list[Part]:
    """A reading lamp with a bent arm."""
    foot = float(rng.uniform(0.08, 0.11))
    elbow = np.array([0, 0.14, float(rng.uniform(0.28, 0.36))])
    tip = elbow + [0, -float(rng.uniform(0.26, 0.34)), float(rng.uniform(0.06, 0.16))]
    parts = frame.on(
        [
            tube("base", (0, 0.05, 0), (0, 0.05, 0.025), [foot, foot], GREY, segments=24),
            bar("arm", (0, 0.05, 0.02), elbow, 0.018, GREY),
            bar("arm", elbow, tip, 0.018, GREY),
            tube("joint", elbow - [0.018, 0, 0], elbow + [0.018, 0, 0], [0.018, 0.018], GREY),
        ]
    )
    aim = np.array([0, -0.35, -0.94])
    cone = tube("head", tip - 0.03 * aim, tip + 0.12 * aim, [0.03, 0.04, 0.085], GREY, segments=24)
    return parts + head.on([cone])


def _shade(rng: np.random.Generator, top: float, radius: float) -> Part:
    """A drum or cone whose lower rim hangs below `top`."""
    tall, narrow = radius * float(rng.uniform(0.9, 1.5)), float(rng.uniform(0.5, 1.0))
    low = top - 0.45 * tall
    return tube("shade", (0, 0, low), (0, 0, low + tall), [radius, narrow * radius], GREY, segments=32)
