"""The object of a photograph, found before whatever background: by a network, or by what the border looks like."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve
from skimage.color import rgb2lab
from skimage.filters import threshold_otsu

from nerfdiff.data.formats.images import decode_with_alpha
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.files import atomic

NETWORKS = ("birefnet-general", "isnet-general-use", "u2net", "u2netp", "silueta")
"""rembg's networks for objects of any kind, the best first."""


@dataclass(frozen=True)
class Mask:
    """Where the object of a picture is.

    Args:
        where: in the picture's pixels.
        how: it was found, in words.
        doubts: what speaks against it, in words.
    """

    where: Bool[np.ndarray, "height width"]
    how: str
    doubts: tuple[str, ...]


@dataclass(frozen=True)
class CutOut:
    """Find the object of a photograph.

    A network of rembg's does where its weights are on this machine; nothing is downloaded. Else colours and edges do,
    as in GrabCut (SIGGRAPH 2004): what the border cannot reach without crossing edges is the first guess; mixtures of
    Gaussians learn the colours of the object and of the rest, a random walk with these priors (Grady, CVPR 2005) cuts
    along edges, and both are repeated. All of it happens twice, the second time around what was found. The edge is then
    refined at a higher resolution by a guided filter (ECCV 2010).

    Args:
        weights: file of a network (ONNX, U²-Net's layout); None: those in rembg's folder (`U2NET_HOME`, `~/.u2net`).
        side: pixels of the picture's longer side when its colours are learnt.
        fine: likewise when the edge is refined.
        border: share of a side, from which paths begin and where the object hardly is.
        colours: Gaussians of each mixture.
        rounds: of learning and cutting.
        smooth: weight of edges between neighbours against colours.
    """

    weights: str | Path | None
    side: int
    fine: int
    border: float
    colours: int
    rounds: int
    smooth: float

    def __post_init__(self):
        for key, possible, expected in (
            ("side", 32 <= self.side <= self.fine, f"32 to fine={self.fine} pixels"),
            ("border", 0 < self.border < 0.25, "a share within (0, 0.25)"),
            ("colours", 1 <= self.colours <= 16, "1 to 16"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("smooth", self.smooth > 0, "more than 0"),
        ):
            if not possible:
                raise ConfigError(f"cutout.{key}={getattr(self, key)}: expected {expected}")

    def find(self, path: str | Path) -> Mask:
        """Find the object of a picture.

        Raises:
            DataError: the picture cannot be read, or nothing stands out from its border.
            ConfigError: weights that are not there, or cannot be used.
        """
        pixels, _ = decode_with_alpha(Path(path), upright=True)
        name = self._network()
        if name is None:
            where, how = self._by_colour(pixels), "by its colours, without a network"
            window = _around(_main_part(where))
            closer = np.zeros_like(where)
            closer[window] = self._by_colour(pixels[window])  # with more of the pixels for the object
            where = closer
        else:
            where, how = _by_network(pixels, name, self.weights), f"by rembg's {name}"
        where = _main_part(where)
        return Mask(where, how, _doubts(path, where))

    def _network(self) -> str | None:
        if self.weights is not None:
            if not Path(self.weights).is_file():
                raise ConfigError(f"cutout.weights={self.weights}: no such file; give the ONNX file of a network")
            return "u2net_custom"
        folder = Path(os.environ.get("U2NET_HOME", Path.home() / ".u2net"))
        return next((name for name in NETWORKS if (folder / f"{name}.onnx").is_file()), None)

    def _by_colour(self, pixels: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        small = rgb2lab(_shrunk(pixels, self.side) / 255)
        small = ndimage.gaussian_filter(small, (0.7, 0.7, 0))
        height, width, _ = small.shape
        band = max(2, round(self.border * max(height, width)))
        edge = np.ones((height, width), bool)
        edge[band:-band, band:-band] = False
        walk = _Walk(small, self.smooth)
        learnt = small.reshape(-1, 3)
        # to begin with, the object is what no path from the border reaches without crossing edges
        crossed = walk.crossed(edge)
        inside = crossed[~edge.ravel()]
        between = threshold_otsu(np.log1p(inside))
        enclosed = (6 * (np.log1p(crossed) - between)).clip(-4, 4)
        found = walk.cut(1 / (1 + np.exp(-enclosed)))
        for _ in range(self.rounds):
            inner = found > 0.5
            if inner.sum() < 20 or (~inner).sum() < 20:
                break
            object_, behind = _Mixture.of(learnt[inner], self.colours), _Mixture.of(learnt[~inner], self.colours)
            difference = (object_.log_density(learnt) - behind.log_density(learnt)).clip(-4, 4)
            share = 1 / (1 + np.exp(-difference - enclosed))
            share[edge.ravel()] = np.minimum(share[edge.ravel()], 0.2)  # an object may touch the border, hardly fill it
            found = walk.cut(share)
        return _refined(pixels, found.reshape(height, width), self.fine)


class _Walk:
    """A random walk over a picture's pixels, which hardly crosses edges."""

    def __init__(self, lab: Float[np.ndarray, "height width 3"], smooth: float):
        height, width, _ = lab.shape
        number = np.arange(height * width).reshape(height, width)
        pairs, weights = [], []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            first = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            second = (slice(down, height), slice(max(0, right), width - max(0, -right)))
            pairs.append(np.stack([number[first].ravel(), number[second].ravel()]))
            weights.append(((lab[first] - lab[second]) ** 2).sum(-1).ravel() / (down + abs(right)))
        (start, end), squared = np.concatenate(pairs, 1), np.concatenate(weights)
        near = smooth * np.exp(-squared / (2 * squared.mean() + 1e-9)) + 1e-4
        graph = sparse.coo_array((near, (start, end)), shape=(number.size, number.size))
        graph = (graph + graph.T).tocsr()
        step = np.sqrt(squared)
        edges = np.maximum(step - 2 * np.median(step) - 0.5, 0) + 1e-3  # slow changes of colour are no edges
        self._edges = sparse.coo_array((edges, (start, end)), shape=graph.shape).tocsr()
        self._matrix = (sparse.diags_array(graph.sum(1) + 1) - graph).tocsc()

    def crossed(self, start: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "pixels"]:
        """Differences of colour that a path from `start` has to cross at least (geodesic saliency, ECCV 2012)."""
        return dijkstra(self._edges, directed=False, indices=np.flatnonzero(start), min_only=True)

    def cut(self, share: Float[np.ndarray, "pixels"]) -> Float[np.ndarray, "pixels"]:
        """The share of the object in each pixel, by what colours alone say of it and its neighbours."""
        return spsolve(self._matrix, share)


@dataclass(frozen=True)
class _Mixture:
    """Gaussians of colours."""

    means: Float[np.ndarray, "k 3"]
    inverse: Float[np.ndarray, "k 3 3"]
    log_weights: Float[np.ndarray, "k"]

    @staticmethod
    def of(colours: Float[np.ndarray, "n 3"], k: int) -> "_Mixture":
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
        return _Mixture(np.stack([part.mean(0) for part in parts]), inverse, np.array(weights))

    def log_density(self, colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Up to a constant that all mixtures share."""
        offsets = colours[:, None] - self.means
        distance = np.einsum("nki,kij,nkj->nk", offsets, self.inverse, offsets)
        return np.logaddexp.reduce(self.log_weights - distance / 2, axis=1)


def _spread(colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    return (np.cov(colours.T) if len(colours) > 1 else np.zeros((3, 3))) + 4.0 * np.eye(3)


def _refined(
    pixels: UInt8[np.ndarray, "height width 3"], share: Float[np.ndarray, "rows columns"], side: int
) -> Bool[np.ndarray, "height width"]:
    """Follow a picture's own edges with a mask of few pixels."""
    guide = _shrunk(pixels, side).astype(np.float32).mean(-1) / 255
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


def _by_network(
    pixels: UInt8[np.ndarray, "height width 3"], name: str, weights: str | Path | None
) -> Bool[np.ndarray, "height width"]:
    try:
        import rembg
    except ImportError as error:
        raise ConfigError("a network's weights are there, but rembg is not: pip install 'nerfdiff[cutout]'") from error
    session = rembg.new_session(name, **({} if weights is None else {"model_path": str(weights)}))
    found = rembg.remove(Image.fromarray(pixels), session=session, only_mask=True)
    return np.asarray(found.convert("L")) > 127


def _around(where: Bool[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """The object's box and half as much again on each side."""
    window = []
    for axis, size in ((1, where.shape[0]), (0, where.shape[1])):
        found = np.flatnonzero(where.any(axis))
        first, last = (found[0], found[-1] + 1) if len(found) else (0, size)
        margin = (last - first) // 2 + 8
        window.append(slice(max(0, first - margin), min(size, last + margin)))
    return window[0], window[1]


def _main_part(where: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The largest connected part without its holes."""
    parts, count = ndimage.label(where)
    if count == 0:
        return where
    return ndimage.binary_fill_holes(parts == 1 + np.argmax(np.bincount(parts.ravel())[1:]))


def _doubts(path: str | Path, where: Bool[np.ndarray, "height width"]) -> tuple[str, ...]:
    border = np.ones(where.shape, bool)
    border[1:-1, 1:-1] = False
    area, touched = where.mean(), where[border].mean()
    if area < 0.002 or area > 0.9 or touched > 0.5:
        raise DataError(
            f"{path}: no object stands out from the background (the mask covers {area:.1%} of the picture and "
            f"{touched:.0%} of its border). Give a mask (mask=<image of its size, white where the object is>), or a "
            "picture with a transparent background"
        )
    doubts = []
    if touched > 0.02:
        doubts.append(f"it touches {touched:.0%} of the picture's border")
    if area < 0.02:
        doubts.append(f"it covers only {area:.1%} of the picture")
    if area > 0.7:
        doubts.append(f"it covers {area:.0%} of the picture")
    return tuple(doubts)


def _shrunk(pixels: UInt8[np.ndarray, "height width 3"], side: int) -> UInt8[np.ndarray, "rows columns 3"]:
    image = Image.fromarray(pixels)
    scale = side / max(image.size)
    if scale >= 1:
        return pixels
    return np.asarray(image.resize([max(8, round(s * scale)) for s in image.size], Image.Resampling.BOX))


def write_mask(mask: Mask, picture: Path, file: Path, shown: Path) -> None:
    """Write a mask, and the picture with all else dimmed and the object's outline drawn, for a person to look at.

    Raises:
        DataError: a file cannot be written.
    """
    with atomic(file) as temporary:
        Image.fromarray(mask.where).save(temporary)
    pixels, _ = decode_with_alpha(picture, upright=True)
    dimmed = np.where(mask.where[..., None], pixels, pixels // 4 + 128)
    width = max(1, max(mask.where.shape) // 300)
    outline = ndimage.binary_dilation(mask.where, iterations=width) & ~mask.where
    dimmed[outline] = (255, 0, 160)
    image = Image.fromarray(dimmed.astype(np.uint8))
    image.thumbnail((1024, 1024))
    with atomic(shown) as temporary:
        image.save(temporary)
