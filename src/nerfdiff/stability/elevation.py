"""From which elevation a picture was taken, by a linear map of the encoder's features."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

STRENGTHS = tuple(10.0**power for power in range(-4, 3))
"""Of the ridge, as shares of the images; the held-out half chooses."""
QUANTILE = 0.9
FEWEST = 100
"""Images that a fit needs."""


@dataclass(frozen=True)
class Elevation:
    """A ridge regression of a camera's elevation on the features of its image.

    Args:
        weights: degrees per unit of each feature.
        offset: degrees.
        low, high: degrees that training images have; an estimate is kept within.
        error, most: degrees by which training images held out are missed: on average, and by 9 of 10 at most.
        spread: degrees by which the training images' median misses them on average.
    """

    weights: Float[Tensor, "dim"]
    offset: float
    low: float
    high: float
    error: float
    most: float
    spread: float

    @staticmethod
    def of(
        found: Float[Tensor, "images dim"], degrees: Float[Tensor, "images"], strengths: Sequence[float] = STRENGTHS
    ) -> "Elevation | None":
        """Fit every other image, and choose the ridge and measure the errors on the others.

        Args:
            found: the images' features.
            degrees: the images' elevations; those that are not finite are not known.

        Returns:
            None where fewer than `FEWEST` are known.
        """
        told = degrees.isfinite()
        found, degrees = found[told], degrees[told]
        if len(found) < FEWEST:
            return None
        x, y = found[::2].double(), degrees[::2].double()
        held_out, truth = found[1::2], degrees[1::2]
        mean, scale, level = x.mean(0), x.std(0) + 1e-6, y.mean()
        centred = (x - mean) / scale
        products, both = centred.T @ centred / len(x), centred.T @ (y - level) / len(x)
        fits = []
        for strength in strengths:
            weights = torch.linalg.solve(products + strength * torch.eye(len(products)).double(), both) / scale
            offset = float(level - mean @ weights)
            one = Elevation(weights.float(), offset, float(y.min()), float(y.max()), 0.0, 0.0, 0.0)
            fits.append((one, (one(held_out) - truth).abs()))
        best, missed = min(fits, key=lambda fit: float(fit[1].mean()))
        spread = float((truth - degrees[::2].median()).abs().mean())
        errors = {"error": float(missed.mean()), "most": float(torch.quantile(missed, QUANTILE)), "spread": spread}
        return Elevation(**{**vars(best), **errors})

    @property
    def useful(self) -> bool:
        """Whether it says at least twice as much as the training images' median does."""
        return self.error <= self.spread / 2

    def __call__(self, found: Float[Tensor, "images dim"]) -> Float[Tensor, "images"]:
        """Estimate elevations in degrees."""
        return (found @ self.weights.to(found) + self.offset).clamp(self.low, self.high)
