"""Cut a picture along its edges: a random walk, mixtures of Gaussians as its priors, and a refined edge."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve


class RandomWalk:
    """A random walk over a picture's pixels, which hardly crosses edges."""

    def __init__(self, lab: Float[np.ndarray, "height width 3"], smooth: float, texture: float):
        height, width, _ = lab.shape
        number = np.arange(height * width).reshape(height, width)
        steps = (
            sum(np.linalg.norm(np.diff(lab, axis=axis, append=lab.take([-1], axis)), axis=-1) for axis in (0, 1)) / 2
        )
        usual = ndimage.uniform_filter(steps, 2 * (max(height, width) // 16) + 1, mode="nearest")
        pairs, weights, around = [], [], []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            first = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            second = (slice(down, height), slice(max(0, right), width - max(0, -right)))
            pairs.append(np.stack([number[first].ravel(), number[second].ravel()]))
            weights.append(((lab[first] - lab[second]) ** 2).sum(-1).ravel() / (down + abs(right)))
            around.append(usual[first].ravel())
        (start, end), squared = np.concatenate(pairs, 1), np.concatenate(weights)
        near = smooth * np.exp(-squared / (2 * squared.mean() + 1e-9)) + 1e-4
        graph = sparse.coo_array((near, (start, end)), shape=(number.size, number.size))
        graph = (graph + graph.T).tocsr()
        step = np.sqrt(squared)
        # slow changes of colour are no edges, nor is a texture
        edges = np.maximum(step - 2 * np.median(step) - 0.5 - texture * np.concatenate(around), 0) + 1e-3
        self._edges = sparse.coo_array((edges, (start, end)), shape=graph.shape).tocsr()
        self._matrix = (sparse.diags_array(graph.sum(1) + 1) - graph).tocsc()

    def crossed(self, start: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "pixels"]:
        """Differences of colour that a path from `start` has to cross at least (geodesic saliency, ECCV 2012)."""
        return dijkstra(self._edges, directed=False, indices=np.flatnonzero(start), min_only=True)

    def cut(self, share: Float[np.ndarray, "pixels"]) -> Float[np.ndarray, "pixels"]:
        """The share of the object in each pixel, by what colours alone say of it and its neighbours."""
        return spsolve(self._matrix, share)


@dataclass(frozen=True)
class Mixture:
    """Hold a mixture of Gaussians of colours."""

    means: Float[np.ndarray, "k 3"]
    inverse: Float[np.ndarray, "k 3 3"]
    log_weights: Float[np.ndarray, "k"]

    @staticmethod
    def of(colours: Float[np.ndarray, "n 3"], k: int) -> "Mixture":
        """Split colours k - 1 times across the widest part (Orchard and Bouman 1991), and fit a Gaussian to each."""
        parts = [colours]
        while len(parts) < k:
            widest = max(parts, key=lambda part: len(part) * np.linalg.eigvalsh(_spread(part))[-1])
            axis = np.linalg.eigh(_spread(widest))[1][:, -1]
            above = (widest - widest.mean(0)) @ axis > 0
            if above.all() or not above.any():
                break
            parts = [part for part in parts if part is not widest] + [widest[above], widest[~above]]
        inverse = np.stack([np.linalg.inv(_spread(part)) for part in parts])
        weights = [
            np.log(len(p) / len(colours)) + np.linalg.slogdet(i)[1] / 2 for p, i in zip(parts, inverse, strict=True)
        ]
        return Mixture(np.stack([part.mean(0) for part in parts]), inverse, np.array(weights))

    def log_density(self, colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the log of the density, up to a constant that all mixtures share."""
        offsets = colours[:, None] - self.means
        distance = np.einsum("nki,kij,nkj->nk", offsets, self.inverse, offsets)
        return np.logaddexp.reduce(self.log_weights - distance / 2, axis=1)


def _spread(colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    return (np.cov(colours.T) if len(colours) > 1 else np.zeros((3, 3))) + 4.0 * np.eye(3)


def refined(
    pixels: UInt8[np.ndarray, "height width 3"], share: Float[np.ndarray, "rows columns"], side: int
) -> Bool[np.ndarray, "height width"]:
    """Follow a picture's own edges with a mask of few pixels."""
    guide = shrunk(pixels, side).astype(np.float32).mean(-1) / 255
    size = (guide.shape[1], guide.shape[0])
    large = np.asarray(Image.fromarray(share.astype(np.float32)).resize(size, Image.Resampling.BILINEAR))
    window = 2 * max(2, round(1.5 * side / max(share.shape))) + 1

    def mean(values):
        return ndimage.uniform_filter(values, window, mode="nearest")

    centre, level = mean(guide), mean(large)
    slope = (mean(guide * large) - centre * level) / (mean(guide * guide) - centre**2 + 1e-3)
    fine = mean(slope) * guide + mean(level - slope * centre)
    back = Image.fromarray(fine.astype(np.float32)).resize(pixels.shape[1::-1], Image.Resampling.BILINEAR)
    return np.asarray(back) > 0.5


def shrunk(pixels: UInt8[np.ndarray, "height width 3"], side: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """Shrink a picture until its longer side has at most `side` pixels."""
    image = Image.fromarray(pixels)
    scale = side / max(image.size)
    if scale >= 1:
        return pixels
    return np.asarray(image.resize([max(8, round(s * scale)) for s in image.size], Image.Resampling.BOX))
