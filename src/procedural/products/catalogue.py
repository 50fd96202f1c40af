"""Every product by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from procedural.chairs import STYLES as CHAIRS
from procedural.mesh import Model, Part
from procedural.paint import pick
from procedural.products.lamps import lamp
from procedural.products.materials import cloth, grain
from procedural.products.planters import planter
from procedural.products.soft import bed, rug, sofa, stool
from procedural.products.storage import cabinet, shelf
from procedural.products.tables import table

UPHOLSTERED = {"cushion", "back", "back_pad", "base", "arm_pad"}
WOODEN = {"leg", "seat", "back_post", "back_board", "rung", "slat", "crest", "stretcher", "spindle", "back_rail"}


def chair(rng: np.random.Generator) -> list[Part]:
    """A chair of any kind, in metres, of fabric that may be patterned and wood with grain."""
    parts = CHAIRS[pick(rng, dict.fromkeys(CHAIRS, 1))](rng)
    patterns = {}
    for part in parts:
        if part.name not in UPHOLSTERED | WOODEN or part.finish != "matte" or part.colour in patterns:
            continue
        red, _, blue = part.colour
        if part.name in UPHOLSTERED:
            patterns[part.colour] = cloth(rng, part.colour)
        else:
            patterns[part.colour] = grain(rng, part.colour) if red > blue + 0.1 else None
    return [replace(part, texture=patterns.get(part.colour)) for part in parts]


STYLES: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "chair": chair,
    "table": table,
    "lamp": lamp,
    "sofa": sofa,
    "shelf": shelf,
    "cabinet": cabinet,
    "stool": stool,
    "bed": bed,
    "planter": planter,
    "rug": rug,
}


def build_product(rng: np.random.Generator, styles: Mapping[str, int | float]) -> Model:
    """One product in metres, standing on the ground z = 0 and facing −y.

    Args:
        rng: the only source of randomness.
        styles: weight of each kind (keys of `STYLES`).
    """
    style = pick(rng, styles)
    return Model(style, tuple(STYLES[style](rng)))
