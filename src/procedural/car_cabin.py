"""The cabin: raked windows, pillars, roof."""

import numpy as np
from jaxtyping import Float

from procedural.car_proportions import Proportions
from procedural.mesh import Part, both_sides, loft, panel
from procedural.paint import CarPaint, window_colour


class Cabin:
    """Corners of the cabin at height fraction t: 0 at the belt line, 1 at the roof."""

    def __init__(self, p: Proportions, roof_bevel: float = 0.07, corner: float = 0.07):
        self.p, self.corner, self.roof_bevel = p, corner, roof_bevel
        self.base = p.belt - 0.03
        self.w0, self.w1 = p.half_width - 0.06, p.half_width - 0.06 - p.tumblehome
        self.y0 = (p.cowl, p.cabin_rear)
        self.y1 = (p.cowl + p.front_rake, p.cabin_rear - p.rear_rake)

    def z(self, t: float) -> float:
        return self.base + t * (self.p.height - self.base)

    def half(self, t: float) -> float:
        return self.w0 + t * (self.w1 - self.w0)

    def front(self, t: float) -> float:
        return self.y0[0] + t * (self.y1[0] - self.y0[0])

    def rear(self, t: float) -> float:
        return self.y0[1] + t * (self.y1[1] - self.y0[1])

    def ring(self, t: float, inset: float = 0.0, z: float | None = None) -> Float[np.ndarray, "points 3"]:
        w, c = self.half(t) - inset, self.corner
        a, b = self.front(t) + inset, self.rear(t) - inset
        z = self.z(t) if z is None else z
        right = [(w - c, a, z), (w, a + c, z), (w, b - c, z), (w - c, b, z)]
        return np.array(right + [(-x, y, zz) for x, y, zz in reversed(right)])

    def across(self, t: float, fraction: float, front: bool) -> tuple[float, float, float]:
        y = self.front(t) if front else self.rear(t)
        return (fraction * (self.half(t) - self.corner), y, self.z(t))


def cabin(p: Proportions, paint: CarPaint, rng: np.random.Generator) -> list[Part]:
    """Greenhouse with raked ends, roof, and dark glossy windows between its pillars."""
    c = Cabin(p)
    top = 1 - c.roof_bevel / (p.height - c.base)
    parts = [loft("cabin", np.stack([c.ring(0.0), c.ring(top)]), paint.cabin, "paint")]
    roof = [c.ring(top), c.ring(1.0, 0.035, c.z(1.0) - 0.02), c.ring(1.0, 0.13, c.z(1.0))]
    parts.append(loft("roof", np.stack(roof), paint.roof, "paint"))

    glass = window_colour(rng, paint.cabin)
    low, high = 0.13, top - 0.02
    f = [c.across(t, s, True) for t, s in ((low, -0.96), (low, 0.96), (high, 0.93), (high, -0.93))]
    parts.append(panel("windshield", np.array(f), glass, "glass"))
    blind = p.style == "van" and rng.random() < 0.45
    rear_low = low if p.rear_rake > 0.2 else 0.22
    r = [c.across(t, s, False) for t, s in ((rear_low, 0.92), (rear_low, -0.92), (high, -0.88), (high, 0.88))]
    if not blind:
        parts.append(panel("rear_window", np.array(r), glass, "glass"))
    for window in _side_windows(c, low, high, rng, p.side_windows if not blind else 1, blind):
        parts += both_sides(panel("side_window", window, glass, "glass"))
    return parts


def _side_windows(
    c: Cabin, low: float, high: float, rng: np.random.Generator, count: int, blind: bool
) -> list[Float[np.ndarray, "4 3"]]:
    """Windows of the side x > 0, from the windshield pillar backwards; vertical pillars between them."""
    pillar, margin = 0.05, c.corner + 0.05
    first, last = c.front(low) + margin, c.rear(low) - margin
    if blind:
        last = min(c.front(high) + margin + float(rng.uniform(0.7, 0.9)), last)
    elif c.p.style == "sports":
        last -= float(rng.uniform(0.15, 0.30))
    usable = last - c.front(0.5)
    cuts = {1: [], 2: [0.52], 3: [0.40, 0.74]}[count]
    inner = [c.front(0.5) + usable * (f + float(rng.uniform(-0.03, 0.03))) for f in cuts]
    windows = []
    for k in range(count):
        corners = []
        for t in (low, high):
            front_edge = max(c.front(t) + margin, first) if k == 0 else inner[k - 1] + pillar
            rear_edge = min(c.rear(t) - margin, last) if k == count - 1 else inner[k] - pillar
            corners.append((c.half(t), front_edge, max(rear_edge, front_edge + 0.05), c.z(t)))
        (x0, a0, b0, z0), (x1, a1, b1, z1) = corners
        windows.append(np.array([(x0, a0, z0), (x0, b0, z0), (x1, b1, z1), (x1, a1, z1)]))
    return windows
