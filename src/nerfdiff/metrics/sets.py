"""Distances between sets of images: the Fréchet distance of two Gaussians fitted to features, and FID."""

import logging
import zipfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerfdiff.metrics.weights import WeightsFile
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic

log = logging.getLogger(__name__)

SETS = "sets.npz"
"""Statistics of a shard's features."""


class GaussianStatistics:
    """Mean and covariance of a stream of feature vectors, in float64 and memory of one covariance.

    Batches are merged around their own means (Chan et al., 1983): sums of squares would cancel where the
    mean is large beside the spread.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean: Tensor | None = None
        self._scatter: Tensor | None = None

    def update(self, features: Float[Tensor, "n dim"]) -> None:
        features = features.detach().double().cpu()
        count = features.shape[0]
        if count == 0:
            return
        mean = features.mean(dim=0)
        centred = features - mean
        self.merge(count, mean, centred.T @ centred)

    def merge(self, count: int, mean: Float[Tensor, "dim"], scatter: Float[Tensor, "dim dim"]) -> None:
        """Add `count` vectors, of which mean and sum of squares around it are known; all in float64."""
        if self.count == 0:
            self.count, self.mean, self._scatter = count, mean, scatter
            return
        total = self.count + count
        shift = mean - self.mean
        self._scatter += scatter + torch.outer(shift, shift) * (self.count * count / total)
        self.mean = self.mean + shift * (count / total)
        self.count = total

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what `merge_arrays` reads; of the symmetric matrix one half."""
        if self.count == 0:
            return {"count": np.array(0)}
        half = self._scatter[*torch.triu_indices(*self._scatter.shape)]
        return {"count": np.array(self.count), "mean": self.mean.numpy(), "scatter": half.numpy()}

    def merge_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Add the vectors of other statistics."""
        if not (count := int(arrays["count"])):
            return
        mean, half = torch.from_numpy(arrays["mean"]), torch.from_numpy(arrays["scatter"])
        scatter = half.new_zeros(len(mean), len(mean))
        scatter[*torch.triu_indices(*scatter.shape)] = half
        self.merge(count, mean, scatter + scatter.triu(1).T)

    @property
    def covariance(self) -> Float[Tensor, "dim dim"]:
        """Unbiased covariance (divided by n − 1), as every FID implementation has it. Needs two vectors."""
        return self._scatter / (self.count - 1)


def _factor(covariance: Float[Tensor, "dim dim"]) -> Float[Tensor, "dim rank"]:
    """A with A Aᵀ = covariance, without the directions whose variance is rounding error."""
    values, vectors = torch.linalg.eigh(covariance)
    threshold = values[-1].clamp(min=0) * len(values) * torch.finfo(values.dtype).eps
    kept = values > threshold
    return vectors[:, kept] * values[kept].sqrt()


def frechet_distance(
    mean1: Float[Tensor, "dim"],
    covariance1: Float[Tensor, "dim dim"],
    mean2: Float[Tensor, "dim"],
    covariance2: Float[Tensor, "dim dim"],
) -> float:
    """Squared Fréchet distance ‖μ1 − μ2‖² + tr(Σ1 + Σ2 − 2 (Σ1 Σ2)^½) of two Gaussians, in float64.

    With Σ1 = A Aᵀ and Σ2 = B Bᵀ, (Σ1 Σ2)^½ has the eigenvalues of the symmetric (Aᵀ Σ2 A)^½, and these are the
    singular values of Aᵀ B. Taking those keeps full precision where covariances are singular (fewer images than
    dimensions): the root of an eigenvalue that should be 0 would turn an error of 1e-16 into 1e-8 per dimension.
    """
    mean1, covariance1, mean2, covariance2 = (x.double().cpu() for x in (mean1, covariance1, mean2, covariance2))
    overlap = torch.linalg.svdvals(_factor(covariance1).T @ _factor(covariance2)).sum()
    distance = (mean1 - mean2).square().sum() + covariance1.trace() + covariance2.trace() - 2 * overlap
    return max(distance.item(), 0.0)


class FrechetDistance:
    """Fréchet distance between two streams of features, predictions and truth."""

    def __init__(self) -> None:
        self.predictions, self.truth = GaussianStatistics(), GaussianStatistics()

    def update(self, predictions: Float[Tensor, "n dim"], truth: Float[Tensor, "m dim"]) -> None:
        self.predictions.update(predictions)
        self.truth.update(truth)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what `merge_arrays` reads."""
        sides = {"predictions": self.predictions, "truth": self.truth}
        return {f"{side}_{name}": value for side, of in sides.items() for name, value in of.arrays().items()}

    def merge_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Add both streams of another distance."""
        for side in ("predictions", "truth"):
            prefix = f"{side}_"
            of = {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
            getattr(self, side).merge_arrays(of)

    def compute(self) -> float | None:
        """The distance; None with fewer than two images on a side, where there is no covariance."""
        if min(self.predictions.count, self.truth.count) < 2:
            return None
        p, t = self.predictions, self.truth
        return frechet_distance(p.mean, p.covariance, t.mean, t.covariance)


def sets(fid: FrechetDistance, fd_st_vgg: FrechetDistance) -> dict[str, float | int | None]:
    """Distances between all predictions and all truth; `fid_n` images stand on either side of both."""
    values = {"fid": fid.compute(), "fd_st_vgg": fd_st_vgg.compute()}
    counts = [of.truth.count for of in (fid, fd_st_vgg) if of.truth.count > 1]
    return values | {"fid_n": max(counts, default=None)}


def write_statistics(path: Path, **distances: FrechetDistance) -> None:
    """Write what is known of the features so far, from which `add_statistics` goes on; see `atomic`."""
    with atomic(path) as temporary:
        arrays = {f"{name}/{key}": value for name, of in distances.items() for key, value in of.arrays().items()}
        np.savez(temporary, **arrays)


def add_statistics(path: Path, **distances: FrechetDistance) -> None:
    """Add the features that `write_statistics` wrote of.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name, distance in distances.items():
                mine = [key for key in arrays if key.startswith(f"{name}/")]
                distance.merge_arrays({key.partition("/")[2]: arrays[key] for key in mine})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); run its shard again") from error


def inception_weights(path: str | Path | None = None) -> Path | None:
    """The StyleGAN/TF Inception's weights file; None and one log line if it (or torch-fidelity) is missing.

    Raises:
        DataError: see `WeightsFile.find`.
    """
    if find_spec("torch_fidelity") is None:
        log.warning("fid is left empty: torch-fidelity is not installed. Install the project's extra `fid`.")
        return None
    from torch_fidelity.feature_extractor_inceptionv3 import URL_INCEPTION_V3

    return WeightsFile(URL_INCEPTION_V3, "6726825d", column="fid", key="metrics.fid_weights").find(path)


class InceptionFeatures:
    """2048 features of the TF Inception v3 (2015-12-05), resized as TensorFlow 1 did (no antialiasing).

    Args:
        weights: from `inception_weights`.
    """

    def __init__(self, weights: Path, device: torch.device | str = "cpu"):
        from torchmetrics.image.fid import NoTrainInceptionV3

        # torch-fidelity unpickles the file without restrictions; one that passes here holds tensors only.
        torch.load(weights, map_location="cpu", weights_only=True)
        with torch.random.fork_rng(devices=[]):
            self.net = NoTrainInceptionV3("inception-v3-compat", ["2048"], str(weights), antialias=False)
        self.net.to(device)
        self.device = torch.device(device)

    @torch.no_grad()
    def __call__(self, images: UInt8[Tensor, "n 3 h w"]) -> Float[Tensor, "n 2048"]:
        return self.net(images.to(self.device)).reshape(len(images), -1).cpu()
