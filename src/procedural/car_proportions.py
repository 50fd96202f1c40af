"""Body styles and the measures of one car.

Metres; x to the sides, the front towards −y, z up, the ground at z = 0.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BodyStyle:
    """Ranges, in metres, from which the proportions of one body style are drawn.

    `hood`, `cabin` are fractions of the length at which the windshield's base and the rear window's base
    lie; `front_rake` and `rear_rake` are the horizontal runs of the two windows.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    clearance: tuple[float, float]
    wheel: tuple[float, float]
    belt: tuple[float, float]
    nose: tuple[float, float]
    hood: tuple[float, float]
    cabin: tuple[float, float]
    front_rake: tuple[float, float]
    rear_rake: tuple[float, float]
    tumblehome: tuple[float, float]
    side_windows: int


STYLES: dict[str, BodyStyle] = {
    "sedan": BodyStyle(
        length=(4.4, 5.0),
        width=(1.74, 1.86),
        height=(1.38, 1.5),
        clearance=(0.15, 0.2),
        wheel=(0.3, 0.34),
        belt=(0.86, 0.96),
        nose=(0.69, 0.8),
        hood=(0.26, 0.31),
        cabin=(0.8, 0.86),
        front_rake=(0.5, 0.75),
        rear_rake=(0.45, 0.75),
        tumblehome=(0.14, 0.24),
        side_windows=2,
    ),
    "hatchback": BodyStyle(
        length=(3.6, 4.3),
        width=(1.66, 1.8),
        height=(1.42, 1.56),
        clearance=(0.15, 0.19),
        wheel=(0.29, 0.33),
        belt=(0.86, 0.96),
        nose=(0.71, 0.82),
        hood=(0.21, 0.26),
        cabin=(0.975, 0.985),
        front_rake=(0.5, 0.75),
        rear_rake=(0.3, 0.6),
        tumblehome=(0.12, 0.22),
        side_windows=2,
    ),
    "wagon": BodyStyle(
        length=(4.5, 5.0),
        width=(1.74, 1.86),
        height=(1.42, 1.54),
        clearance=(0.15, 0.2),
        wheel=(0.3, 0.34),
        belt=(0.86, 0.96),
        nose=(0.69, 0.8),
        hood=(0.25, 0.29),
        cabin=(0.98, 0.985),
        front_rake=(0.5, 0.75),
        rear_rake=(0.2, 0.45),
        tumblehome=(0.12, 0.22),
        side_windows=3,
    ),
    "suv": BodyStyle(
        length=(4.3, 5.0),
        width=(1.82, 1.98),
        height=(1.66, 1.88),
        clearance=(0.24, 0.3),
        wheel=(0.36, 0.42),
        belt=(1.02, 1.14),
        nose=(0.93, 1.05),
        hood=(0.24, 0.28),
        cabin=(0.98, 0.985),
        front_rake=(0.35, 0.6),
        rear_rake=(0.1, 0.3),
        tumblehome=(0.1, 0.2),
        side_windows=3,
    ),
    "pickup": BodyStyle(
        length=(5.0, 5.7),
        width=(1.82, 2.0),
        height=(1.68, 1.86),
        clearance=(0.26, 0.32),
        wheel=(0.37, 0.42),
        belt=(1.04, 1.14),
        nose=(0.96, 1.06),
        hood=(0.23, 0.27),
        cabin=(0.5, 0.64),
        front_rake=(0.4, 0.6),
        rear_rake=(0.05, 0.2),
        tumblehome=(0.12, 0.22),
        side_windows=1,
    ),
    "van": BodyStyle(
        length=(4.5, 5.5),
        width=(1.8, 2.0),
        height=(1.9, 2.3),
        clearance=(0.18, 0.24),
        wheel=(0.31, 0.35),
        belt=(1.04, 1.18),
        nose=(0.84, 1.0),
        hood=(0.12, 0.18),
        cabin=(0.985, 0.99),
        front_rake=(0.45, 0.75),
        rear_rake=(0.03, 0.12),
        tumblehome=(0.06, 0.16),
        side_windows=3,
    ),
    "sports": BodyStyle(
        length=(4.1, 4.6),
        width=(1.82, 1.98),
        height=(1.16, 1.28),
        clearance=(0.1, 0.14),
        wheel=(0.32, 0.36),
        belt=(0.78, 0.86),
        nose=(0.58, 0.68),
        hood=(0.33, 0.4),
        cabin=(0.86, 0.93),
        front_rake=(0.65, 0.9),
        rear_rake=(0.8, 1.15),
        tumblehome=(0.18, 0.28),
        side_windows=1,
    ),
}


@dataclass(frozen=True)
class Proportions:
    """The drawn measures of one car, in metres; positions along y are negative towards the front."""

    style: str
    length: float
    width: float
    height: float
    clearance: float
    wheel: float
    belt: float
    nose: float
    deck: float
    cowl: float
    cabin_rear: float
    front_rake: float
    rear_rake: float
    tumblehome: float
    side_windows: int
    front_axle: float
    rear_axle: float

    @property
    def front(self) -> float:
        return -self.length / 2

    @property
    def rear(self) -> float:
        return self.length / 2

    @property
    def half_width(self) -> float:
        return self.width / 2

    @property
    def bed_floor(self) -> float:
        return self.belt - 0.22

    def half_width_at(self, y: float) -> float:
        """The body tapers towards both bumpers."""
        ends = [self.front, self.front + 0.30, self.rear - 0.25, self.rear]
        return float(np.interp(y, ends, np.array([0.87, 1.0, 1.0, 0.92]) * self.half_width))

    def top_at(self, y: float) -> float:
        """Height of the body without the cabin: bonnet, belt line, boot."""
        ys = [self.front, self.front + 0.14, self.cowl, self.cabin_rear]
        zs = [self.nose - 0.05, self.nose, self.belt, self.belt]
        if self.style == "pickup":
            ys += [self.cabin_rear + 0.01, self.rear]
            zs += [self.bed_floor, self.bed_floor]
        else:
            ys += [self.rear - 0.10, self.rear]
            zs += [self.deck, self.deck - 0.05]
        return float(np.interp(y, ys, zs))


def draw_proportions(style: str, rng: np.random.Generator) -> Proportions:
    """Draw the measures of a car of `style`."""
    s = STYLES[style]

    def draw(bounds: tuple[float, float]) -> float:
        return float(rng.uniform(*bounds))

    length, wheel, belt = draw(s.length), draw(s.wheel), draw(s.belt)
    deck = belt - draw((0.0, 0.08)) if style in ("sedan", "sports") else belt
    return Proportions(
        style=style,
        length=length,
        width=draw(s.width),
        height=draw(s.height),
        clearance=draw(s.clearance),
        wheel=wheel,
        belt=belt,
        nose=draw(s.nose),
        deck=deck,
        cowl=length * (draw(s.hood) - 0.5),
        cabin_rear=length * (draw(s.cabin) - 0.5),
        front_rake=draw(s.front_rake),
        rear_rake=draw(s.rear_rake),
        tumblehome=draw(s.tumblehome),
        side_windows=s.side_windows,
        front_axle=-length / 2 + wheel + draw((0.32, 0.48)),
        rear_axle=length / 2 - wheel - draw((0.36, 0.56)),
    )
