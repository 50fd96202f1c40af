"""Read what was spent on each scene, and how hard it is: the PSNR that the reference has on it."""

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scipy.stats import spearmanr

from nerfdiff.metrics.summary import LARGEST
from nerfdiff.results.frame import Configuration, Run
from nerfdiff.results.paired import over_seeds

MEASURED = ("distill", "denoiser_calls")  # seconds of distillation, and how often the denoiser was asked
SCHEDULE = "schedule"  # what ends a scene that has had all steps of its budget
ADAPTIVE = ("quality", "seconds_per_scene")
FEWEST = 3  # scenes of which a rank correlation says something


def is_adaptive(configuration: Configuration, spent: Sequence[Mapping[str, Mapping[str, Any]]]) -> bool:
    """Return true if a budget follows the scene, by its overrides or by scenes that ended before their schedule."""
    settings = (word.lstrip("+").partition("=") for word in configuration.settings)
    said = any(
        key in ADAPTIVE or (key.partition(".")[0] == "budget" and "adaptive" in value) for key, _, value in settings
    )
    ends = {scene["stopped_by"] for seed in spent for scene in seed.values() if "stopped_by" in scene}
    return said or bool(ends - {SCHEDULE})


def spent_by(run: Run, warn: Callable[[str], object]) -> dict[str, dict[str, Any]]:
    """Per scene of a run what `MEASURED` names and why it ended, as far as is known.

    It stands in the run's scores, and of runs of before in their predictions.

    The seconds of a scene that warmed the device up are left out.
    """
    path = run.file("scores", str(run.row.strategy), "per_scene.csv")
    try:
        if path is not None and path.stat().st_size <= LARGEST:
            with open(path, newline="", encoding="utf-8") as file:
                lines = list(csv.DictReader(file))
            if lines and any(name in lines[0] for name in MEASURED):
                return {line["scene"]: _known(line) for line in lines}
        return _from_predictions(run)
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        warn(f"{run.row.folder}: what its scenes took cannot be read ({error})")
        return {}


def _from_predictions(run: Run) -> dict[str, dict[str, Any]]:
    found = {}
    folder = run.file("predictions", str(run.row.strategy))
    for scene in sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder is not None else ():
        path = run.file("predictions", str(run.row.strategy), scene, "scene.json")
        if path is None or path.stat().st_size > LARGEST:
            continue
        facts = json.loads(path.read_text(encoding="utf-8"))
        cost = dict(facts["cost"])
        if cost.get("warm") is False:
            cost.pop("distill", None)
        found[scene] = _known({"stopped_by": facts.get("stopped_by")} | cost)
    return found


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    numbers = {name: float(values[name]) for name in MEASURED if values.get(name) not in (None, "")}
    found = {name: value for name, value in numbers.items() if math.isfinite(value)}
    return found | ({"stopped_by": str(values["stopped_by"])} if values.get("stopped_by") else {})


def spending_values(
    spent: Sequence[Mapping[str, Mapping[str, Any]]], difficulty: Mapping[str, float]
) -> dict[str, Any] | None:
    """A configuration's scenes as the page has them; None where too few are known.

    Args:
        spent: per seed and scene.
        difficulty: PSNR of the reference per scene; the lower, the harder.
    """
    numbers = [
        {scene: {n: v for n, v in own.items() if n in MEASURED} for scene, own in seed.items()} for seed in spent
    ]
    found: dict[str, Any] = {}
    for name, values in over_seeds(numbers).items():
        scenes = [scene for scene in sorted(values) if scene in difficulty]
        hard, paid = [difficulty[scene] for scene in scenes], [values[scene] for scene in scenes]
        if len(scenes) >= FEWEST and all(map(math.isfinite, hard)):
            same = len(set(paid)) == 1 or len(set(hard)) == 1
            rho = None if same else float(spearmanr([-value for value in hard], paid).statistic)
            found[name] = {
                "scenes": scenes,
                "psnr": [round(value, 2) for value in hard],
                "spent": [float(f"{value:.4g}") for value in paid],
                "rho": None if rho is None else round(rho, 2),
            }
    return found or None
