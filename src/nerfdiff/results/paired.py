"""Differences scene by scene, so that what makes a scene hard cancels."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from nerfdiff.results.intervals import Bootstrap, Estimate, mean_of

SceneValues = dict[str, float]


def over_seeds(scores: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, SceneValues]:
    """The mean over seeds of each metric in each scene, of scenes where all seeds have it.

    Args:
        scores: per seed, scene and metric; see `read_scores`.
    """
    seeds = [_by_metric(seed) for seed in scores]
    values = {}
    for metric in seeds[0] if seeds else ():
        common = [scene for scene in seeds[0][metric] if all(scene in seed.get(metric, {}) for seed in seeds)]
        if common:
            values[metric] = {scene: mean_of([seed[metric][scene] for seed in seeds]) for scene in common}
    return values


def difference(own: SceneValues, others: SceneValues, bootstrap: Bootstrap) -> Estimate | None:
    """How much more one has than the other over the scenes that both have, and its interval; None without such."""
    both = {scene: value - others[scene] for scene, value in own.items() if scene in others}
    return bootstrap(in_order(both)) if both else None


def in_order(values: SceneValues) -> Float[np.ndarray, "scenes"]:
    """By the names of scenes: draws of scenes are then the same for every metric and configuration."""
    return np.array([values[scene] for scene in sorted(values)])


def _by_metric(scores: Mapping[str, Mapping[str, float]]) -> dict[str, SceneValues]:
    values: dict[str, SceneValues] = {}
    for scene, measured in scores.items():
        for metric, value in measured.items():
            values.setdefault(metric, {})[scene] = value
    return values
