"""A histogram of how far scenes are from their cameras, with near and far."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from nerfdiff.results.text import figure_text
from nerfdiff.utils.files import atomic

INSIDE, OUTSIDE = "#4c78a8", "#d62728"


@dataclass(frozen=True)
class Distances:
    """Distances in one scene, and its bounds; `evidence` says of what the distances are."""

    values: Float[np.ndarray, " n"]
    near: float
    far: float
    evidence: str


def write_bounds_plot(path: Path, scenes: Sequence[Distances], title: str, bins: int, dpi: int) -> Path | None:
    """Save the histogram; None where no scene has any distance.

    Distances are in scene units where all scenes have the same bounds, else placed between near (0) and far (1).
    """
    scenes = [scene for scene in scenes if len(scene.values) and 0 < scene.near < scene.far]
    if not scenes:
        return None
    shared = len({(scene.near, scene.far) for scene in scenes}) == 1
    near, far = (scenes[0].near, scenes[0].far) if shared else (0.0, 1.0)
    values = np.concatenate([s.values if shared else (s.values - s.near) / (s.far - s.near) for s in scenes])
    # every scene counts alike, however many pixels it covers
    weights = np.concatenate([np.full(len(s.values), 100 / len(s.values) / len(scenes)) for s in scenes])
    low, high = min(values.min(), near), max(values.max(), far)
    # bins start at near and are so wide that far is an edge as well, so that none is half outside
    width = (far - near) / (round(bins * (far - near) / (high - low)) | 1)  # odd, so that the middle is in one bin
    edges = near + width * np.arange(np.floor((low - near) / width - 1e-9), np.ceil((high - near) / width + 1e-9) + 1)
    counts, _ = np.histogram(values, edges, weights=weights)
    middles = (edges[:-1] + edges[1:]) / 2
    colours = np.where((middles >= near) & (middles <= far), INSIDE, OUTSIDE)
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(edges[:-1], counts, width=width * 0.94, align="edge", color=colours)
    for bound, name, side in ((near, "near", "right"), (far, "far", "left")):
        axes.axvline(bound, color="black", linestyle="--", linewidth=1)
        label = f"{name} = {bound:.4g}" if shared else name
        where = {"xytext": (-4 if side == "right" else 4, -4), "textcoords": "offset points", "ha": side, "va": "top"}
        axes.annotate(label, (bound, 1.0), xycoords=("data", "axes fraction"), fontsize=9, **where)
    surfaces = scenes[0].evidence == "surfaces"
    what = "distance along the ray of what pixels hit" if surfaces else "distance of cameras from what they look at"
    axes.set_xlabel(f"{what}, {'scene units' if shared else 'from near (0) to far (1) of each scene'}")
    axes.set_ylabel("share of the pixels, %" if surfaces else "share of the cameras, %")
    axes.set_title(figure_text(title), fontsize=11)
    axes.margins(x=0.12, y=0.15)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path
