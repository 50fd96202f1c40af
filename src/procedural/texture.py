"""Procedural textures as small repeating bitmaps, laid on parts by box projection."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

Colour = tuple[float, float, float]
SIDE = 128


@dataclass(frozen=True)
class Texture:
    """A pattern over a part's colour.

    Args:
        pattern: one of `PATTERNS`.
        second: the other colour of the pattern (grain, stripe, speckle, …), sRGB.
        size: extent of one repeat, in the units of the vertices, along and across the longest side of a face;
            (0, 0): once over the whole part.
        seed: of what is random in the pattern.
    """

    pattern: str
    second: Colour
    size: tuple[float, float]
    seed: int = 0

    def pixels(self, colour: Colour) -> UInt8[np.ndarray, "side side 3"]:
        """The bitmap; rows run across, columns along. `colour` is the part's own, sRGB."""
        rng = np.random.default_rng([self.seed, zlib.crc32(self.pattern.encode())])
        share = np.clip(PATTERNS[self.pattern](rng), 0, 1)[..., None]
        mixed = (1 - share) * np.array(colour) + share * np.array(self.second)
        return np.round(np.clip(mixed, 0, 1) * 255).astype(np.uint8)

    def scaled(self, factor: float) -> "Texture":
        """The same texture on vertices that were scaled."""
        return Texture(self.pattern, self.second, (self.size[0] * factor, self.size[1] * factor), self.seed)


def box_coordinates(corners: Float[np.ndarray, "faces 3 3"], texture: Texture) -> Float[np.ndarray, "faces 3 2"]:
    """Texture coordinates: every triangle is projected along the axis that it faces most."""
    points = corners.reshape(-1, 3)
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faced = np.abs(normals).argmax(axis=1)
    order = np.argsort(-extent, kind="stable")
    # The pattern runs along the longer of the two axes that remain, as grain runs along a board.
    along, across = np.array([[a for a in order if a != f] for f in range(3)])[faced].T
    where = corners - low
    uv = np.stack([np.take_along_axis(where, a[:, None, None], axis=2)[..., 0] for a in (along, across)], axis=-1)
    size = np.array(texture.size)
    if not size.any():
        return uv / np.maximum(np.stack([extent[along], extent[across]], axis=-1)[:, None], 1e-9)
    return uv / size


def _waves(rng: np.random.Generator, count: int, along: int, across: int) -> Float[np.ndarray, "side side"]:
    """A sum of periodic waves with whole numbers of periods: it repeats without a seam. Deviation 1."""
    v, u = np.mgrid[:SIDE, :SIDE] / SIDE
    total = np.zeros((SIDE, SIDE))
    for _ in range(count):
        a, b = rng.integers(-along, along + 1), rng.integers(1, across + 1)
        total += np.cos(2 * np.pi * (a * u + b * v) + rng.uniform(0, 2 * np.pi))
    return total / np.sqrt(count / 2)


def _wood(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    v = np.mgrid[:SIDE, :SIDE][0] / SIDE
    rings = np.sin(2 * np.pi * (5 * v + 0.35 * _waves(rng, 12, 2, 3)))
    return 0.38 + 0.22 * rings + 0.13 * _waves(rng, 40, 2, 40)


def _planks(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    v = np.mgrid[:SIDE, :SIDE][0]
    tone = rng.uniform(-0.25, 0.25, 4)[v * 4 // SIDE]
    return np.where(v % (SIDE // 4) < 2, 1.0, _wood(rng) + tone)


def _stripes(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    u = np.mgrid[:SIDE, :SIDE][1] / SIDE
    return (u % 0.5 < rng.uniform(0.15, 0.3)).astype(float)


def _checks(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    v, u = np.mgrid[:SIDE, :SIDE] * 2 // SIDE
    return 0.5 * u + 0.5 * v if rng.random() < 0.5 else ((u + v) % 2).astype(float)


def _weave(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    v, u = np.mgrid[:SIDE, :SIDE] / SIDE
    over = (np.floor(8 * u) + np.floor(8 * v)) % 2
    thread = np.where(over > 0, np.sin(np.pi * (8 * u % 1)), np.sin(np.pi * (8 * v % 1)))
    return 0.75 - 0.6 * thread + 0.08 * _waves(rng, 30, 30, 30)


def _speckle(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    return 3.0 * (_waves(rng, 60, 14, 14) - 0.9)


def _marble(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    veins = np.abs(_waves(rng, 10, 2, 3) + 0.3 * _waves(rng, 20, 8, 8))
    return 0.8 * np.exp(-6 * veins) + 0.1 * _waves(rng, 10, 3, 3)


def _dots(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    v, u = np.mgrid[:SIDE, :SIDE] / SIDE * 2
    row = np.floor(v)
    distance = np.hypot((u + 0.5 * (row % 2)) % 1 - 0.5, v % 1 - 0.5)
    return (distance < rng.uniform(0.18, 0.3)).astype(float)


def _bordered(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    """A rug: nested borders around a field of diamonds or a medallion."""
    v, u = np.abs(np.mgrid[:SIDE, :SIDE] / (SIDE - 1) * 2 - 1)
    rim = np.maximum(u, v)
    first, last = np.sort(rng.uniform(0.70, 0.92, 2))
    border = (rim > first) & (rim < last)
    count = int(rng.integers(3, 6))
    lattice = (np.abs((count * u) % 1 - 0.5) + np.abs((count * v) % 1 - 0.5)) < rng.uniform(0.25, 0.4)
    medallion = (np.floor(5 * (u + v)) % 2 == 0) & (u + v < 1.0)
    field = lattice if rng.random() < 0.5 else medallion
    return np.where(rim < first - 0.06, field, border).astype(float) * 0.9 + 0.05


PATTERNS: dict[str, Callable[[np.random.Generator], Float[np.ndarray, "side side"]]] = {
    "wood": _wood,
    "planks": _planks,
    "stripes": _stripes,
    "checks": _checks,
    "weave": _weave,
    "speckle": _speckle,
    "marble": _marble,
    "dots": _dots,
    "bordered": _bordered,
}
