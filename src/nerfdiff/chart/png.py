"""The charts as PNGs, for where no page can be."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nerfdiff.chart.panels import Panel
from nerfdiff.chart.payload import Measured
from nerfdiff.results.intervals import Estimate
from nerfdiff.results.text import figure_text, one_line
from nerfdiff.utils.files import atomic

INK, PAPERS = "#1d2430", "#6b4a00"
KINDS = ("#0b62b8", "#d1570a", "#1a8a5a", "#8a4fbf", "#b3261e", "#0f8fa3", "#8a6d1d", "#c2408f", "#5d8a00", "#5c6675")
FAINT = 0.3
LONGEST, SHORT = 400, 40  # letters of a name below the axes, and in the legend
LINE, LETTERS = 0.16, 18  # inches of a line below the axes, and letters of it to an inch


def write_png(
    path: Path,
    content: Measured,
    panel: Panel,
    metric: Mapping[str, Any],
    cost: Mapping[str, Any],
    published: Sequence[Mapping[str, Any]],
    size: Sequence[float],
    dpi: int,
    lines: int,
) -> Path:
    """One panel's chart of one metric against one cost, coloured by strategy; dominated points are faint.

    The frontier's points have numbers, which lines below the axes explain.

    Args:
        published: of which those that have both numbers are drawn.
        size: inches, without these lines.
        lines: at most so many points of the frontier are explained.

    Raises:
        DataError: the file cannot be written.
    """
    best = content.frontiers[content.panels.index(panel)][metric["field"]][cost["field"]]
    points = content.points(panel, metric["field"], cost["field"])
    at = {n: (content.estimates[n][cost["field"]], content.estimates[n][metric["field"]]) for n in points}
    told = [_told(number, content.names[n], at[n], metric, cost) for number, n in enumerate(best[:lines], 1)]
    if len(best) > lines:
        told.append(f"and {len(best) - lines} more, in configurations.csv")
    told = [figure_text(fill(text, int(LETTERS * size[0]), subsequent_indent="    ")) for text in told]
    height = size[1] + LINE * sum(text.count("\n") + 1 for text in told)
    figure = Figure(figsize=(size[0], height), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    _scale(axes, [at[n][0].mean for n in points])
    kinds = _kinds({n: content.found[n].row.strategy or "?" for n in points})
    shown = set(best)
    for (_, own), colour in zip(kinds, KINDS, strict=False):
        _errorbars(axes, [at[n] for n in own if n not in shown], colour, FAINT)
        _errorbars(axes, [at[n] for n in own if n in shown], colour, 1)
    for number, n in enumerate(best[:lines], 1):
        place = (at[n][0].mean, at[n][1].mean)
        axes.annotate(str(number), place, (-5, 5), textcoords="offset points", ha="right", fontsize=8, color=INK)
    _published(axes, metric["field"], cost["field"], published)
    _steps(axes, [(at[n][0].mean, at[n][1].mean) for n in best])
    axes.set_xlabel(_titled(cost))
    axes.set_ylabel(_titled(metric))
    if metric["better"] == "lower":
        axes.invert_yaxis()
    axes.grid(alpha=0.25)
    axes.set_title(figure_text(fill(one_line(f"{panel.device}: {panel.data}", LONGEST), int(12 * size[0]))), fontsize=9)
    dots = [
        Line2D([], [], color=colour, marker="o", ls="", label=figure_text(one_line(name, SHORT)))
        for (name, _), colour in zip(kinds, KINDS, strict=False)
    ]
    axes.legend(handles=dots, fontsize=7, loc="best")
    key = [Line2D([], [], ls="", label=text) for text in told]
    figure.legend(handles=key, loc="outside lower left", fontsize=7, frameon=False, handlelength=0, labelspacing=0.2)
    with atomic(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a name in letters of another script
        FigureCanvasAgg(figure).print_png(temporary)
    return path


def _kinds(strategies: Mapping[int, str]) -> list[tuple[str, list[int]]]:
    """The points of each strategy, by name; where there are more than colours, the last kind has all others."""
    members: dict[str, list[int]] = {}
    for number, strategy in strategies.items():
        members.setdefault(strategy, []).append(number)
    kinds = sorted(members.items())
    if len(kinds) > len(KINDS):
        rest = kinds[len(KINDS) - 1 :]
        kinds[len(KINDS) - 1 :] = [(f"{len(rest)} others", [number for _, own in rest for number in own])]
    return kinds


def _titled(quantity: Mapping[str, Any]) -> str:
    return f"{quantity['name']}, {quantity['unit']}" if quantity["unit"] else quantity["name"]


def _told(
    number: int,
    name: str,
    point: tuple[Estimate, Estimate],
    metric: Mapping[str, Any],
    cost: Mapping[str, Any],
) -> str:
    values = f"{point[1].mean:.{metric['digits']}f} {metric['unit']}".strip(), f"{point[0].mean:.3g} {cost['unit']}"
    return f"{number}: {values[0]} at {values[1].strip()}: {one_line(name, LONGEST)}"


def _steps(axes: Axes, places: Sequence[tuple[float, float]]) -> None:
    """The frontier, on to the right edge."""
    low, high = axes.get_xlim()
    x, y = zip(*places, strict=True)
    axes.step([*x, high], [*y, y[-1]], where="post", color=INK, linewidth=1)
    axes.set_xlim(low, high)


def _errorbars(axes: Axes, points: Sequence[tuple[Estimate, Estimate]], colour: str, alpha: float) -> None:
    if not points:
        return
    x, y = ([point[axis].mean for point in points] for axis in (0, 1))
    ends = [[list(side) for side in zip(*(_ends(point[axis]) for point in points), strict=True)] for axis in (0, 1)]
    axes.errorbar(x, y, xerr=ends[0], yerr=ends[1], fmt="o", color=colour, alpha=alpha, markersize=5, elinewidth=0.8)


def _ends(estimate: Estimate) -> tuple[float, float]:
    if estimate.low is None or estimate.high is None:
        return 0.0, 0.0
    return max(estimate.mean - estimate.low, 0.0), max(estimate.high - estimate.mean, 0.0)


def _scale(axes: Axes, costs: Sequence[float]) -> None:
    """Logarithmic; around zero, which a logarithm lacks, linear up to the lowest other cost."""
    positive = [cost for cost in costs if cost > 0]
    if len(positive) == len(costs):
        axes.set_xscale("log")
    elif positive:
        axes.set_xscale("symlog", linthresh=min(positive))


def _published(axes: Axes, metric: str, cost: str, published: Sequence[Mapping[str, Any]]) -> None:
    for entry in published:
        if metric in entry["metrics"] and cost in entry["costs"]:
            place = (entry["costs"][cost], entry["metrics"][metric])
            axes.plot(*place, "D", color=PAPERS, fillstyle="none", markersize=6)
            text = f"{entry['method']} (published, {entry['image_size']})"
            axes.annotate(text, place, (6, -9), textcoords="offset points", fontsize=7, color=PAPERS)
