"""Colours: weighted palettes with a little jitter, all in sRGB."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from procedural.mesh import Colour

# Shares roughly as seen on real roads, the rarer bright colours raised so that they are learnt as well.
CAR_COLOURS: dict[str, tuple[int, Colour]] = {
    "white": (14, (0.92, 0.92, 0.91)),
    "black": (11, (0.09, 0.09, 0.10)),
    "graphite": (8, (0.30, 0.31, 0.33)),
    "silver": (11, (0.70, 0.71, 0.73)),
    "red": (14, (0.76, 0.10, 0.10)),
    "maroon": (4, (0.42, 0.08, 0.12)),
    "blue": (12, (0.12, 0.28, 0.66)),
    "navy": (5, (0.09, 0.14, 0.33)),
    "sky": (4, (0.45, 0.66, 0.84)),
    "green": (6, (0.10, 0.45, 0.22)),
    "lime": (2, (0.55, 0.74, 0.18)),
    "yellow": (7, (0.94, 0.78, 0.12)),
    "orange": (5, (0.91, 0.45, 0.10)),
    "brown": (3, (0.38, 0.25, 0.16)),
    "beige": (4, (0.80, 0.73, 0.58)),
    "teal": (2, (0.08, 0.46, 0.48)),
    "purple": (2, (0.36, 0.18, 0.48)),
}
DARK_TRIM: Colour = (0.13, 0.13, 0.14)
CHROME: Colour = (0.68, 0.69, 0.70)
GLASS: tuple[Colour, Colour] = ((0.13, 0.15, 0.17), (0.40, 0.45, 0.49))


def pick(rng: np.random.Generator, weights: Mapping[str, int | float]) -> str:
    """One key, drawn with these weights."""
    names, shares = list(weights), np.array(list(weights.values()), np.float64)
    return names[rng.choice(len(names), p=shares / shares.sum())]


def jitter(rng: np.random.Generator, colour: Colour, amount: float = 0.05) -> Colour:
    """`colour` made lighter or darker and shifted slightly, kept within [0.02, 0.95]."""
    values = np.array(colour) * (1 + rng.uniform(-2, 2) * amount) + rng.uniform(-amount, amount, 3) / 2
    return tuple(float(v) for v in np.clip(values, 0.02, 0.95))


@dataclass(frozen=True)
class CarPaint:
    """Colours of the painted parts of one car."""

    body: Colour
    cabin: Colour
    roof: Colour
    bumpers: Colour
    cladding: Colour | None
    stripe: Colour | None


def window_colour(rng: np.random.Generator, around: Colour) -> Colour:
    """Dark to greyish blue; never the darkest within dark paint, where windows would vanish."""
    low = 0.55 if np.mean(around) < 0.25 else 0.0
    t = float(rng.uniform(low, 1.0))
    return tuple(a + t * (b - a) for a, b in zip(*GLASS, strict=True))


def _car_colour(rng: np.random.Generator) -> Colour:
    name = pick(rng, {k: w for k, (w, _) in CAR_COLOURS.items()})
    return jitter(rng, CAR_COLOURS[name][1])


def car_paint(rng: np.random.Generator, style: str) -> CarPaint:
    """Draw the paint: one colour, a contrasting roof, dark cladding or a bonnet stripe."""
    body = _car_colour(rng)
    cabin = roof = body
    if rng.random() < 0.22:
        roof = jitter(rng, CAR_COLOURS["white" if np.mean(body) < 0.5 else "black"][1])
        if rng.random() < 0.4:
            cabin = roof
    bumpers = body if rng.random() < 0.45 else (DARK_TRIM if rng.random() < 0.6 else CHROME)
    cladding = None
    if rng.random() < (0.7 if style in ("suv", "pickup") else 0.3):
        cladding = DARK_TRIM if rng.random() < 0.6 else _car_colour(rng)
    stripe = None
    if rng.random() < (0.4 if style == "sports" else 0.04):
        stripe = CAR_COLOURS["white" if np.mean(body) < 0.6 else "black"][1]
    return CarPaint(body, cabin, roof, bumpers, cladding, stripe)
