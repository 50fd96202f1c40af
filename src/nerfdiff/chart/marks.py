"""Colours and shapes of strategies, the same on the page and in its pictures."""

from collections.abc import Iterable
from dataclasses import dataclass

# eight that people with any colour blindness tell apart (Okabe and Ito, 2008); their yellow is darker, for white paper
KINDS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#56b4e9", "#e69f00", "#8a7a00")
OTHER = "#8b929c"
# names of plotly, and of matplotlib; diamonds are published values
SHAPES = (
    ("circle", "o"), ("square", "s"), ("triangle-up", "^"), ("x", "X"), ("star", "*"), ("triangle-down", "v"),
    ("cross", "P"), ("pentagon", "p"), ("hourglass", "d"), ("hexagon", "h"), ("triangle-left", "<"),
    ("triangle-right", ">"),
)  # fmt: skip


@dataclass(frozen=True)
class Mark:
    """The colour and shape of a strategy; `marker` is matplotlib's name of the shape."""

    colour: str
    shape: str
    marker: str


def marks_of(strategies: Iterable[str]) -> dict[str, Mark]:
    """A mark for each strategy; beyond 24, which is as many as there are, they come again."""
    names = enumerate(sorted(set(strategies)))
    return {name: Mark(KINDS[at % len(KINDS)], *SHAPES[at % len(SHAPES)]) for at, name in names}
