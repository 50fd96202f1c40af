"""What the inputs that a model was trained on look like: by the encoder's own features, and by plain facts."""

import json
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.field.encoder import Encoding
from nerfdiff.stability.elevation import Elevation
from nerfdiff.stability.facts import FACTS, OF_PICTURE, excess, facts, of_picture, usual_range
from nerfdiff.stress.photo import Picture
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic

log = logging.getLogger(__name__)

FAMILIAR = "familiar.safetensors"
"""The file beside a model's weights."""
QUANTILE = 0.99


def features(encoding: Encoding) -> Float[Tensor, "batch dim"] | None:
    """Return means and spreads over space of the features that the CDM attends to; None where there are none."""
    maps = [level.flatten(2) for level in encoding.context if isinstance(level, Tensor)]
    return torch.cat([part for level in maps for part in (level.mean(-1), level.std(-1))], 1).float() if maps else None


@dataclass(frozen=True)
class Familiar:
    """The features of training images: their principal axes, and what is left beside them; and their facts' ranges.

    Args:
        mean: of the features.
        axes: orthonormal.
        spread: standard deviation along each axis.
        rest: root mean square of what the axes leave, over dimensions and images.
        usual: distance that 99 % of images held out from the axes do not exceed.
        ranges: lower end, median and upper end of the training inputs' facts; None in files from before there were any.
        elevation: estimates a framed picture's from its features; None where it is not known, or was not then.
    """

    mean: Float[Tensor, "dim"]
    axes: Float[Tensor, "dim kept"]
    spread: Float[Tensor, "kept"]
    rest: float
    usual: float
    ranges: Float[Tensor, "facts 3"] | None = None
    elevation: Elevation | None = None

    @staticmethod
    def of(found: Float[Tensor, "images dim"], kept: int, known: Float[Tensor, "images facts"]) -> "Familiar":
        """Take axes from every other image, the usual distance from the others, and ranges from all.

        Args:
            found: the images' features.
            kept: axes at most.
            known: the images' facts.
        """
        fitted, held_out = found[::2].double(), found[1::2]
        mean = fitted.mean(0)
        _, sizes, rows = torch.linalg.svd(fitted - mean, full_matrices=False)
        kept = min(kept, len(sizes) - 1)
        axes, spread = rows[:kept].T, sizes[:kept] / len(fitted) ** 0.5
        left = (fitted - mean) - (fitted - mean) @ axes @ axes.T
        parts = (mean.float(), axes.float().contiguous(), spread.float())
        unscaled = Familiar(*parts, rest=float(left.square().mean().sqrt()), usual=1.0)
        usual = float(torch.quantile(unscaled.distance(held_out), QUANTILE))
        return Familiar(*parts, rest=unscaled.rest, usual=usual, ranges=usual_range(known))

    def distance(self, found: Float[Tensor, "images dim"]) -> Float[Tensor, "images"]:
        """Return distances, 1 being as far as the 99th of 100 training images: along the axes and beside them."""
        mean, axes, spread = (part.to(found) for part in (self.mean, self.axes, self.spread))
        centred = found - mean
        along = centred @ axes
        beside = (centred - along @ axes.T).square().mean(1) / self.rest**2
        return ((along / spread).square().mean(1) + beside).sqrt() / self.usual

    def beyond(self, scene: ViewBatch) -> dict[str, float]:
        """Return how far each fact of one scene's input lies beyond the training inputs' range, in its widths.

        Those that could not be measured, or have no range, are left out.
        """
        return {} if self.ranges is None else _named(tuple(FACTS), facts(scene)[0], self.ranges)

    def picture_beyond(self, image: Picture) -> dict[str, float]:
        """The same of a picture alone.

        Raises:
            TypeError: there are no ranges.
        """
        found = torch.tensor(list(of_picture(image).values()))
        return _named(OF_PICTURE, found, self.ranges[-len(OF_PICTURE) :])

    def usual_value(self, fact: str) -> float:
        """Return the training inputs' median of a fact.

        Raises:
            TypeError: there are no ranges.
        """
        return float(self.ranges[list(FACTS).index(fact), 1])

    def framing(self) -> dict[str, Any] | None:
        """Return settings of a `Picture` with which it is framed as the training inputs were; None: unknown."""
        if self.ranges is None:
            return None
        middle = {name: round(self.usual_value(name), 4) for name in FACTS}
        return {
            "fov": round(math.degrees(2 * math.atan(0.5 / middle["focal"])), 2),
            "near": middle["near"],
            "far": middle["far"],
            "object_share": middle["share"],
            "object_centre": [0.5 + middle["across"] / 2, 0.5 + middle["along"] / 2],
        }

    def save(self, path: Path) -> None:
        """Write a file that `load` reads, in halves.

        Raises:
            DataError: it cannot be written.
        """
        tensors = {"mean": self.mean, "axes": self.axes.half(), "spread": self.spread}
        if self.ranges is not None:
            tensors["ranges"] = self.ranges.contiguous()
        about = {"familiar": json.dumps({"rest": self.rest, "usual": self.usual}), "facts": json.dumps(list(FACTS))}
        if self.elevation is not None:
            numbers = dict(vars(self.elevation))
            tensors["elevation"] = numbers.pop("weights")
            about["elevation"] = json.dumps(numbers)
        with atomic(path) as temporary:
            save_file(tensors, temporary, about)

    @staticmethod
    def beside(weights: Path) -> "Familiar | None":
        """Read what lies beside a model's weights, if anything does; a file that stays the same is read once.

        Raises:
            DataError: it is damaged.
        """
        path = weights.parent / FAMILIAR
        if not path.is_file():
            return None
        state = path.stat()
        return _load(path, state.st_mtime_ns, state.st_size)

    @staticmethod
    def load(path: Path) -> "Familiar":
        """Read what `save` wrote.

        Raises:
            DataError: it is missing or damaged.
        """
        try:
            with safe_open(path, framework="pt") as file:
                numbers = json.loads(file.metadata()["familiar"])
                names = json.loads(file.metadata().get("facts", "[]"))
                if names != list(FACTS):
                    log.warning("%s: has no ranges of this version's facts; make it again (docs/stability.md)", path)
                ranges = file.get_tensor("ranges") if names == list(FACTS) else None
                parts = (file.get_tensor(name).float() for name in ("mean", "axes", "spread"))
                about = file.metadata().get("elevation")
                elevation = about and Elevation(file.get_tensor("elevation"), **json.loads(about))
                return Familiar(*parts, **numbers, ranges=ranges, elevation=elevation)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{path}: cannot be read ({error}); delete it, or make it again (docs/stability.md)"
            ) from error


def _named(names: Sequence[str], found: Tensor, usual: Tensor) -> dict[str, float]:
    beyond = excess(found, usual).tolist()
    return {name: value for name, value in zip(names, beyond, strict=True) if not math.isnan(value)}


def measured(model, batches: Iterable[ViewBatch]) -> tuple[Float[Tensor, "images dim"], Float[Tensor, "images facts"]]:
    """Return the features and the facts of the inputs of batches."""
    with torch.no_grad():
        found = [(features(model.encode(batch)).cpu(), facts(batch)) for batch in batches]
    return torch.cat([each for each, _ in found]), torch.cat([each for _, each in found])


@lru_cache(maxsize=4)
def _load(path: Path, modified: int, size: int) -> Familiar:
    return Familiar.load(path)
