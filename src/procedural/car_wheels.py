"""Tyres, rims and spokes."""

import numpy as np

from procedural.car_proportions import Proportions
from procedural.mesh import Colour, Part, both_sides, panel, tube
from procedural.paint import CHROME

TYRE: Colour = (0.07, 0.07, 0.075)


def wheels(p: Proportions, rng: np.random.Generator) -> list[Part]:
    """Four tyres with rims and spokes."""
    metal = CHROME if rng.random() < 0.75 else (0.20, 0.20, 0.21)
    dark = (0.12, 0.12, 0.13) if metal is CHROME else (0.05, 0.05, 0.05)
    rim, spokes = p.wheel * float(rng.uniform(0.58, 0.72)), int(rng.integers(4, 8))
    phase, spoke_width = float(rng.uniform(0, np.pi)), float(rng.uniform(0.16, 0.34))
    parts: list[Part] = []
    for axle in (p.front_axle, p.rear_axle):
        outer = p.half_width_at(axle) - 0.005
        centre = np.array([0.0, axle, p.wheel])
        inner_x, outer_x = outer - 0.22, outer
        x = np.array([1.0, 0.0, 0.0])
        tyre = tube(
            "tyre",
            centre + inner_x * x,
            centre + outer_x * x,
            [0.93 * p.wheel, p.wheel, p.wheel, 0.90 * p.wheel],
            TYRE,
            segments=20,
            positions=[0, 0.12, 0.85, 1],
        )
        dish = tube(
            "rim",
            centre + (outer_x - 0.05) * x,
            centre + (outer_x + 0.006) * x,
            [rim, rim],
            dark,
            segments=20,
        )
        parts += both_sides(tyre) + both_sides(dish)
        hub = centre + (outer_x + 0.004) * x
        for k in range(spokes):
            angle = phase + 2 * np.pi * k / spokes
            along = np.array([0, np.cos(angle), np.sin(angle)])
            across = np.array([0, -np.sin(angle), np.cos(angle)]) * spoke_width * rim
            corners = [hub + across, hub - across, hub + 0.95 * rim * along - 0.6 * across]
            corners.append(hub + 0.95 * rim * along + 0.6 * across)
            parts += both_sides(panel("spoke", np.array(corners)[::-1], metal, proud=0.012))
        parts += both_sides(tube("hub", hub, hub + 0.02 * x, [0.22 * rim, 0.18 * rim], metal, segments=8))
    return parts
