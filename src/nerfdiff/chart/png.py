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

from nerfdiff.chart.against import has_interval
from nerfdiff.chart.marks import Mark, marks_of
from nerfdiff.chart.panels import Panel
from nerfdiff.chart.payload import Measured
from nerfdiff.results.intervals import Estimate
from nerfdiff.results.text import figure_text, one_line
from nerfdiff.utils.files import atomic

INK, PAPERS = "#1d2430", "#6b4a00"
FAINT = 0.3
MOST = 12  # strategies in the legend
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
    """One panel's chart of one metric against one cost; dominated points are faint.

    As on the page, it has those alone that leave a field (unless none does), and bars are intervals of differences to
    the reference, whose own value is a broken line. The frontier's points have numbers, which lines below explain.

    Args:
        published: of which those that have both numbers are drawn.
        size: inches, without these lines.
        lines: at most so many points of the frontier are explained.

    Raises:
        DataError: the file cannot be written.
    """
    best = content.frontiers_3d[content.panels.index(panel)][metric["field"]][cost["field"]]
    points = content.points(panel, metric["field"], cost["field"], only_3d=True)
    at = {n: (content.estimates[n][cost["field"]], content.estimates[n][metric["field"]]) for n in points}
    told = [_told(number, content.names[n], at[n], metric, cost) for number, n in enumerate(best[:lines], 1)]
    if len(best) > lines:
        told.append(f"and {len(best) - lines} more, in configurations.csv")
    told = [figure_text(fill(text, int(LETTERS * size[0]), subsequent_indent="    ")) for text in told]
    height = size[1] + LINE * sum(text.count("\n") + 1 for text in told)
    figure = Figure(figsize=(size[0], height), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    _scale(axes, [at[n][0].mean for n in points])
    marks = marks_of(configuration.row.strategy or "?" for configuration in content.found)
    strategies = {n: content.found[n].row.strategy or "?" for n in points}
    for n in points:
        bar = _bar(content.differences[n].get(metric["field"]))
        _point(axes, at[n], bar, marks[strategies[n]], 1 if n in best else FAINT)
    reference = content.reference(panel)
    if reference in at:
        axes.axhline(at[reference][1].mean, color=INK, linewidth=0.8, linestyle=(0, (4, 4)), zorder=0)
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
    shown = sorted(set(strategies.values()))
    dots = [
        Line2D([], [], color=marks[name].colour, marker=marks[name].marker, ls="", label=_short(name))
        for name in shown[:MOST]
    ]
    if len(shown) > MOST:
        dots.append(Line2D([], [], ls="", label=f"and {len(shown) - MOST} others"))
    axes.legend(handles=dots, fontsize=7, loc="best")
    key = [Line2D([], [], ls="", label=text) for text in told]
    figure.legend(handles=key, loc="outside lower left", fontsize=7, frameon=False, handlelength=0, labelspacing=0.2)
    with atomic(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a name in letters of another script
        FigureCanvasAgg(figure).print_png(temporary)
    return path


def _short(name: str) -> str:
    return figure_text(one_line(name, SHORT))


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


def _point(axes: Axes, point: tuple[Estimate, Estimate], bar: tuple[float, float], mark: Mark, alpha: float) -> None:
    ends = [[end] for end in bar]
    style = {"fmt": mark.marker, "color": mark.colour, "markersize": 6, "elinewidth": 0.8}
    axes.errorbar([point[0].mean], [point[1].mean], yerr=ends, alpha=alpha, **style)


def _bar(difference: Estimate | None) -> tuple[float, float]:
    """Return how far the interval of a difference reaches below and above it."""
    if difference is None or not has_interval(difference):
        return 0.0, 0.0
    return max(difference.mean - difference.low, 0.0), max(difference.high - difference.mean, 0.0)


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
