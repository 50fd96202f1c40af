"""Procedural chairs: wooden, upholstered, office, moulded and tubular ones, all facing −y."""

from collections.abc import Callable, Mapping

import numpy as np

from procedural import chairs_modern, chairs_wooden
from procedural.mesh import Model, Part
from procedural.paint import pick

STYLES: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "dining": chairs_wooden.dining,
    "windsor": chairs_wooden.windsor,
    "bar": chairs_wooden.bar_stool,
    "armchair": chairs_modern.armchair,
    "office": chairs_modern.office,
    "shell": chairs_modern.shell,
    "cantilever": chairs_modern.cantilever,
}


def build_chair(rng: np.random.Generator, styles: Mapping[str, int | float]) -> Model:
    """One chair, normalised to the unit diagonal and facing −y.

    Args:
        rng: the only source of randomness.
        styles: weight of each kind (keys of `STYLES`).
    """
    style = pick(rng, styles)
    return Model(style, tuple(STYLES[style](rng))).normalised()
