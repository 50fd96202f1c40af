"""From which elevation a picture was taken, by a linear map of the encoder's features."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.picture import area_resample, window_around
from nerfdiff.stress.photo import object_mask

STRENGTHS = tuple(10.0**power for power in range(-4, 3))
"""Strengths of the ridge that are tried, per image. The one with the least error on the held-out half is taken."""
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
        """Choose the ridge and measure the errors with a fit of every other image on the others; then fit them all.

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
        held_out, truth = found[1::2], degrees[1::2]
        missed = {s: (_ridge(found[::2], degrees[::2], s)(held_out) - truth).abs() for s in strengths}
        best = min(missed, key=lambda strength: float(missed[strength].mean()))
        return replace(
            _ridge(found, degrees, best),
            error=float(missed[best].mean()),
            most=float(torch.quantile(missed[best], QUANTILE)),
            spread=float((truth - degrees[::2].median()).abs().mean()),
        )

    @property
    def useful(self) -> bool:
        """Return true if the estimate's mean error is at most half that of always saying the median."""
        return self.error <= self.spread / 2

    def __call__(self, found: Float[Tensor, "images dim"]) -> Float[Tensor, "images"]:
        """Estimate elevations in degrees."""
        return (found @ self.weights.to(found) + self.offset).clamp(self.low, self.high)


def _ridge(found: Float[Tensor, "images dim"], degrees: Float[Tensor, "images"], strength: float) -> Elevation:
    """Fit elevations, features being scaled to one spread; the errors are not measured."""
    x, y = found.double(), degrees.double()
    mean, scale, level = x.mean(0), x.std(0) + 1e-6, y.mean()
    centred = (x - mean) / scale
    products = centred.T @ centred / len(x) + strength * torch.eye(x.shape[1]).double()
    weights = torch.linalg.solve(products, centred.T @ (y - level) / len(x)) / scale
    return Elevation(weights.float(), float(level - mean @ weights), float(y.min()), float(y.max()), 0.0, 0.0, 0.0)


def framed(scene: ViewBatch, framing: Mapping[str, Any]) -> ViewBatch:
    """Frame the input of a batch of one scene as pictures are: its place and size tell of elevations else, and lie.

    Args:
        framing: of `Familiar.framing`.
    """
    where = object_mask(scene.source[0].cpu()).numpy()
    if not where.any():
        return scene
    pixels, size = scene.source_pixels[0].cpu().movedim(0, -1).numpy(), where.shape
    window = window_around(where, size[1] / size[0], framing["object_share"], framing["object_centre"])
    shown = torch.from_numpy(area_resample(pixels, window, size)).movedim(-1, 0)
    return replace(scene, source_pixels=shown[None].to(scene.source_pixels))
