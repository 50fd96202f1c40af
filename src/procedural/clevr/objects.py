"""Objects on CLEVR's table: shapes, sizes, colours, materials and a layout without collisions."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nerfdiff.utils.errors import ConfigError
from procedural.mesh import Colour

SHAPES = ("cube", "sphere", "cylinder")
SIZES = {"small": 0.35, "large": 0.7}
MATERIALS = ("rubber", "metal")
# CLEVR's own values, 8-bit sRGB.
COLOURS: dict[str, tuple[int, int, int]] = {
    "gray": (87, 87, 87),
    "red": (173, 35, 35),
    "blue": (42, 75, 215),
    "green": (29, 105, 20),
    "brown": (129, 74, 25),
    "purple": (129, 38, 192),
    "cyan": (41, 208, 208),
    "yellow": (255, 238, 51),
}


@dataclass(frozen=True)
class ClevrObject:
    """One object.

    Args:
        shape, colour, material: of `SHAPES`, `COLOURS`, `MATERIALS`.
        size: half of its height, except that cubes are as much smaller as fits the same circle (size / √2).
        x, y: its centre.
        rotation: degrees about the vertical.
    """

    shape: str
    colour: str
    material: str
    size: float
    x: float
    y: float
    rotation: float

    @property
    def half_height(self) -> float:
        return self.size / np.sqrt(2) if self.shape == "cube" else self.size

    @property
    def srgb(self) -> Colour:
        return tuple(value / 255 for value in COLOURS[self.colour])

    def facts(self) -> dict[str, Any]:
        """Return the facts as plain values."""
        return asdict(self)


def place_objects(
    rng: np.random.Generator, count: tuple[int, int], extent: float, gap: float
) -> tuple[ClevrObject, ...]:
    """Between `count[0]` and `count[1]` objects with centres within ±`extent`, at least `gap` apart.

    Raises:
        ConfigError: so many objects do not fit.
    """
    wanted = int(rng.integers(count[0], count[1] + 1))
    for _ in range(40):
        placed: list[ClevrObject] = []
        for _ in range(50 * wanted):
            candidate = _draw(rng, extent)
            if all(
                np.hypot(candidate.x - other.x, candidate.y - other.y) > candidate.size + other.size + gap
                for other in placed
            ):
                placed.append(candidate)
            if len(placed) == wanted:
                return tuple(placed)
    raise ConfigError(
        f"scenes.objects={list(count)}: {wanted} objects at least scenes.gap={gap} apart do not fit within "
        f"scenes.extent={extent}; ask for fewer or a larger extent"
    )


def _draw(rng: np.random.Generator, extent: float) -> ClevrObject:
    x, y = rng.uniform(-extent, extent, 2)
    return ClevrObject(
        SHAPES[rng.integers(len(SHAPES))],
        list(COLOURS)[rng.integers(len(COLOURS))],
        MATERIALS[rng.integers(len(MATERIALS))],
        list(SIZES.values())[rng.integers(len(SIZES))],
        float(x),
        float(y),
        float(rng.uniform(0, 360)),
    )
