"""Materials of products: colours with a pattern over them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from procedural.chair_parts import FABRICS, METALS, WOODS, draw_colour
from procedural.mesh import Colour, Part
from procedural.paint import jitter, pick
from procedural.texture import Texture

CERAMICS: dict[str, tuple[int, Colour]] = {
    "white": (3, (0.90, 0.89, 0.86)),
    "sand": (2, (0.76, 0.66, 0.50)),
    "terracotta": (3, (0.70, 0.36, 0.22)),
    "blue": (2, (0.16, 0.30, 0.55)),
    "sage": (2, (0.48, 0.58, 0.46)),
    "black": (1, (0.13, 0.13, 0.14)),
}


@dataclass(frozen=True)
class Material:
    """Colour, finish and pattern of some parts."""

    colour: Colour
    finish: str = "matte"
    texture: Texture | None = None

    def on(self, parts: Sequence[Part]) -> list[Part]:
        """The same parts made of this."""
        return [replace(p, colour=self.colour, finish=self.finish, texture=self.texture) for p in parts]


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**16))


def _contrast(rng: np.random.Generator, colour: Colour) -> Colour:
    """Clearly lighter than a dark colour, darker than a light one, sometimes of another hue."""
    mean = np.mean(colour)
    if rng.random() < 0.4:
        other = draw_colour(rng, FABRICS)
        if abs(np.mean(other) - mean) > 0.25:
            return other
    factor = 0.45 if mean > 0.45 else 0.35
    return tuple(float(c * factor if mean > 0.45 else c + factor * (1 - c)) for c in colour)


def grain(rng: np.random.Generator, colour: Colour) -> Texture:
    """Wood grain, or planks, over a colour of wood."""
    dark = tuple(0.55 * c for c in colour)
    pattern = "planks" if rng.random() < 0.15 else "wood"
    return Texture(pattern, dark, (float(rng.uniform(0.7, 1.2)), float(rng.uniform(0.18, 0.4))), _seed(rng))


def cloth(rng: np.random.Generator, colour: Colour) -> Texture | None:
    """Weave, stripes, checks, dots, or none, over a colour of fabric."""
    pattern = pick(rng, {"weave": 3, "stripes": 2, "checks": 2, "dots": 1, "plain": 2})
    if pattern == "plain":
        return None
    if pattern == "weave":
        return Texture(pattern, tuple(0.55 * c for c in colour), (0.12, 0.12), _seed(rng))
    size = float(rng.uniform(0.14, 0.30))
    return Texture(pattern, _contrast(rng, colour), (size, size), _seed(rng))


def wood(rng: np.random.Generator) -> Material:
    """Painted wood is plain, stained wood shows its grain."""
    colour = draw_colour(rng, WOODS)
    saturation = max(colour) - min(colour)
    stained = saturation > 0.1 and colour[0] > colour[2]
    return Material(colour, "matte", grain(rng, colour) if stained else None)


def fabric(rng: np.random.Generator) -> Material:
    """Upholstery."""
    colour = draw_colour(rng, FABRICS)
    return Material(colour, "matte", cloth(rng, colour))


def metal(rng: np.random.Generator) -> Material:
    """Lacquered or polished metal, plain."""
    return Material(draw_colour(rng, METALS), "paint")


def ceramic(rng: np.random.Generator) -> Material:
    """Glazed: plain, speckled, or banded."""
    colour = draw_colour(rng, CERAMICS)
    pattern = pick(rng, {"plain": 3, "speckle": 2, "stripes": 2})
    texture = None
    if pattern != "plain":
        texture = Texture(pattern, _contrast(rng, colour), (0.16, 0.16), _seed(rng))
    return Material(colour, "glass", texture)


def stone(rng: np.random.Generator) -> Material:
    """Marble or terrazzo."""
    colour = jitter(rng, (0.86, 0.85, 0.83) if rng.random() < 0.65 else (0.20, 0.21, 0.22))
    pattern = "marble" if rng.random() < 0.65 else "speckle"
    return Material(colour, "glass", Texture(pattern, _contrast(rng, colour), (0.7, 0.7), _seed(rng)))
