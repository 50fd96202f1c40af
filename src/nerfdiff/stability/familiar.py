"""The distance of an input image from those that a model was trained on, by the encoder's own features."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nerfdiff.field.encoder import Encoding
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic

FAMILIAR = "familiar.safetensors"
"""The file beside a model's weights."""
QUANTILE = 0.99


def features(encoding: Encoding) -> Float[Tensor, "batch dim"] | None:
    """Return means and spreads over space of the features that the CDM attends to; None where there are none."""
    maps = [level.flatten(2) for level in encoding.context if isinstance(level, Tensor)]
    return torch.cat([part for level in maps for part in (level.mean(-1), level.std(-1))], 1).float() if maps else None


@dataclass(frozen=True)
class Familiar:
    """The features of training images: their principal axes, and what is left beside them.

    Args:
        mean: of the features.
        axes: orthonormal.
        spread: standard deviation along each axis.
        rest: root mean square of what the axes leave, over dimensions and images.
        usual: distance that 99 % of images held out from the axes do not exceed.
    """

    mean: Float[Tensor, "dim"]
    axes: Float[Tensor, "dim kept"]
    spread: Float[Tensor, "kept"]
    rest: float
    usual: float

    @staticmethod
    def of(found: Float[Tensor, "images dim"], kept: int) -> "Familiar":
        """Take axes from every other image, and the usual distance from the others."""
        fitted, held_out = found[::2].double(), found[1::2]
        mean = fitted.mean(0)
        _, sizes, rows = torch.linalg.svd(fitted - mean, full_matrices=False)
        kept = min(kept, len(sizes) - 1)
        axes, spread = rows[:kept].T, sizes[:kept] / len(fitted) ** 0.5
        left = (fitted - mean) - (fitted - mean) @ axes @ axes.T
        parts = (mean.float(), axes.float().contiguous(), spread.float())
        unscaled = Familiar(*parts, rest=float(left.square().mean().sqrt()), usual=1.0)
        usual = float(torch.quantile(unscaled.distance(held_out), QUANTILE))
        return Familiar(*parts, rest=unscaled.rest, usual=usual)

    def distance(self, found: Float[Tensor, "images dim"]) -> Float[Tensor, "images"]:
        """Return distances, 1 being as far as the 99th of 100 training images: along the axes and beside them."""
        mean, axes, spread = (part.to(found) for part in (self.mean, self.axes, self.spread))
        centred = found - mean
        along = centred @ axes
        beside = (centred - along @ axes.T).square().mean(1) / self.rest**2
        return ((along / spread).square().mean(1) + beside).sqrt() / self.usual

    def save(self, path: Path) -> None:
        """Write a file that `load` reads, in halves.

        Raises:
            DataError: it cannot be written.
        """
        tensors = {"mean": self.mean, "axes": self.axes.half(), "spread": self.spread}
        with atomic(path) as temporary:
            save_file(tensors, temporary, {"familiar": json.dumps({"rest": self.rest, "usual": self.usual})})

    @staticmethod
    def load(path: Path) -> "Familiar":
        """Read what `save` wrote.

        Raises:
            DataError: it is missing or damaged.
        """
        try:
            with safe_open(path, framework="pt") as file:
                numbers = json.loads(file.metadata()["familiar"])
                return Familiar(*(file.get_tensor(name).float() for name in ("mean", "axes", "spread")), **numbers)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{path}: cannot be read ({error}); delete it, or make it again (docs/stability.md)"
            ) from error


def features_of(model, batches: Iterable) -> Float[Tensor, "images dim"]:
    """Return the features of the inputs of batches."""
    with torch.no_grad():
        return torch.cat([features(model.encode(batch)).cpu() for batch in batches])
