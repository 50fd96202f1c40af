"""Potted plants, vases with branches, empty planters."""

import numpy as np
from jaxtyping import Float

from procedural.chair_parts import bar, sheet
from procedural.mesh import Colour, Part, tube
from procedural.paint import jitter, pick
from procedural.products.materials import ceramic, wood
from procedural.products.pieces import GREY, shifted, turned

SOIL: Colour = (0.20, 0.14, 0.10)
GREENS: tuple[Colour, ...] = ((0.16, 0.42, 0.16), (0.26, 0.50, 0.20), (0.12, 0.33, 0.22), (0.40, 0.55, 0.24))


def planter(rng: np.random.Generator) -> list[Part]:
    """A pot of some profile with a snake plant, a palm, a bush, or nothing in it."""
    radius, tall = float(rng.uniform(0.10, 0.17)), float(rng.uniform(0.16, 0.32))
    profile = {
        "taper": [0.72, 0.8, 0.9, 1.0, 1.0],
        "bowl": [0.55, 0.85, 1.0, 1.0, 0.92],
        "drum": [1.0, 1.0, 1.0, 1.0, 1.0],
        "urn": [0.6, 0.95, 1.1, 0.95, 0.8],
    }
    shape = profile[list(profile)[rng.integers(len(profile))]]
    lift = float(rng.uniform(0.12, 0.2)) if rng.random() < 0.3 else 0.0
    pot = tube("pot", (0, 0, lift), (0, 0, lift + tall), [radius * r for r in shape], GREY, segments=32)
    rim = lift + tall
    soil = tube("soil", (0, 0, rim - 0.02), (0, 0, rim + 0.004), [0.9 * radius * shape[-1]] * 2, SOIL, segments=24)
    parts = [*ceramic(rng).on([pot]), soil]
    if lift:
        legs = []
        for k in range(4):
            c, s = np.cos(np.pi * (k / 2 + 0.25)), np.sin(np.pi * (k / 2 + 0.25))
            legs.append(bar("leg", (radius * c, radius * s, lift + 0.06), (radius * c, radius * s, 0), 0.025, GREY))
        ring = tube("stand", (0, 0, lift - 0.02), (0, 0, lift + 0.002), [radius, radius], GREY, segments=32)
        parts += wood(rng).on([*legs, ring])
    green = jitter(rng, GREENS[rng.integers(len(GREENS))])
    plant = pick(rng, {"snake": 1, "palm": 1.2, "bush": 1.2})
    return parts + {"snake": _snake, "palm": _palm, "bush": _bush}[plant](rng, rim, radius, green)


def _leaf(length: float, width: float, start: float, droop: float, colour: Colour) -> Part:
    """A pointed leaf that rises from the origin at slope `start` (radians) towards +y and droops."""
    t = np.linspace(0, 1, 7)
    angle = start - droop * t
    step = length / 6
    y = np.concatenate([[0], np.cumsum(step * np.cos(angle[1:]))])
    z = np.concatenate([[0], np.cumsum(step * np.sin(angle[1:]))])
    half = width / 2 * np.array([0.35, 0.75, 1.0, 1.0, 0.85, 0.55, 0.06])
    return sheet("leaf", list(zip(y, z, strict=True)), half, 0.006, colour, bowl=0.12 * width, columns=5)


def _placed(leaf: Part, angle: float, z: float, outwards: float = 0.0) -> Part:
    return turned(shifted(leaf, (0, outwards, z)), angle)


def _snake(rng: np.random.Generator, rim: float, radius: float, green: Colour) -> list[Part]:
    """Upright swords."""
    leaves = []
    for _ in range(int(rng.integers(7, 12))):
        leaf = _leaf(
            float(rng.uniform(0.3, 0.6)),
            float(rng.uniform(0.05, 0.07)),
            1.5,
            float(rng.uniform(-0.1, 0.25)),
            jitter(rng, green),
        )
        leaves.append(
            _placed(leaf, float(rng.uniform(0, 2 * np.pi)), rim - 0.01, float(rng.uniform(0.1, 0.6)) * radius)
        )
    return leaves


def _palm(rng: np.random.Generator, rim: float, radius: float, green: Colour) -> list[Part]:
    """A stem with a crown of drooping leaves."""
    stem = float(rng.uniform(0.15, 0.45))
    parts = [tube("stem", (0, 0, rim - 0.01), (0, 0, rim + stem), [0.022, 0.015], (0.36, 0.27, 0.17))]
    count = int(rng.integers(9, 14))
    for k in range(count):
        leaf = _leaf(
            float(rng.uniform(0.3, 0.48)),
            float(rng.uniform(0.06, 0.10)),
            float(rng.uniform(0.7, 1.35)),
            float(rng.uniform(1.0, 1.9)),
            jitter(rng, green),
        )
        parts.append(_placed(leaf, 2 * np.pi * k / count + float(rng.uniform(-0.2, 0.2)), rim + stem - 0.02))
    return parts


def _bush(rng: np.random.Generator, rim: float, radius: float, green: Colour) -> list[Part]:
    """Short branches with round tufts, clipped to a ball."""
    parts = [tube("stem", (0, 0, rim - 0.01), (0, 0, rim + 0.15), [0.02, 0.015], (0.33, 0.24, 0.15))]
    size, centre = float(rng.uniform(0.16, 0.26)), np.array([0, 0, rim + 0.14])
    for _ in range(int(rng.integers(12, 20))):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        r = size * float(rng.uniform(0.32, 0.45))
        middle = centre + [0, 0, 0.55 * size] + 0.6 * size * direction
        parts.append(_tuft(middle, r, jitter(rng, green)))
    return parts


def _tuft(centre: Float[np.ndarray, "3"], radius: float, colour: Colour) -> Part:
    """A coarse ball."""
    height = np.cos(np.linspace(0.2, np.pi - 0.2, 7))
    pole = np.array([0, 0, radius])
    radii, places = radius * np.sqrt(1 - height**2), (1 - height) / 2
    return tube("tuft", centre - pole, centre + pole, radii, colour, segments=12, positions=places)
