"""The object of a photograph, found before whatever background: by a network, or by what the border looks like."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage
from skimage.color import rgb2lab
from skimage.filters import threshold_otsu
from skimage.morphology import convex_hull_image

from nerfdiff.data.formats.images import decode_with_alpha
from nerfdiff.data.random_walk import Mixture, RandomWalk, refined, shrunk
from nerfdiff.inputs import check_box
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.files import atomic

NETWORKS = ("birefnet-general", "isnet-general-use", "u2net", "u2netp", "silueta")
"""rembg's networks for objects of any kind, the best first."""
GIVE = (
    "Say where the object is (box=[left,top,right,bottom], in pixels), give a mask (mask=<image of its size, white "
    "where the object is>), or a picture with a transparent background"
)
SMALL = 0.02
"""Share of a picture below which an object is small."""


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

    def __repr__(self) -> str:
        height, width = self.where.shape
        return f"Mask({height}x{width} pixels, {self.where.mean():.0%} of them the object, found {self.how})"


@dataclass(frozen=True)
class CutOut:
    """Find the object of a photograph.

    A network of rembg's does where its weights are on this machine; nothing is downloaded. Else colours and edges do,
    as in GrabCut (SIGGRAPH 2004): what the border cannot reach without crossing edges is the first guess; mixtures of
    Gaussians learn the colours of the object and of the rest, a random walk with these priors (Grady, CVPR 2005) cuts
    along edges, and both are repeated. The picture is read twice: as it is, and with edges counting only where they
    stand out from a textured surrounding, and the middle more. The reading counts whose outline follows edges, and
    which lies nearer to the middle. All of it happens again around what was found. The edge is then refined at a higher
    resolution by a guided filter (ECCV 2010).

    Args:
        weights: file of a network (ONNX, U²-Net's layout); None: those in rembg's folder (`U2NET_HOME`, `~/.u2net`).
        box: [left, top, right, bottom] in pixels, in which the object lies; None: anywhere.
        side: pixels of the picture's longer side when its colours are learnt.
        fine: likewise when the edge is refined.
        border: share of a side, from which paths begin and where the object hardly is.
        colours: Gaussians of each mixture.
        rounds: of learning and cutting.
        smooth: weight of edges between neighbours against colours.
        texture: means of the surrounding's edges that an edge must exceed in the second reading.
        centre: spread of where objects are, in half sides around a point just below the middle.
        contrast: difference of colours (CIELAB) across an outline that counts as an edge.
        clear: least score of a reading, which is in [0, 1]; below it a picture is refused.
        sure: score below which a mask is doubted.
        others: area of the next part that stands out against the main one's, from which on the mask is doubted.
    """

    weights: str | Path | None
    box: Sequence[float] | None
    side: int
    fine: int
    border: float
    colours: int
    rounds: int
    smooth: float
    texture: float
    centre: float
    contrast: float
    clear: float
    sure: float
    others: float

    def __post_init__(self):
        for key, possible, expected in (
            ("side", 32 <= self.side <= self.fine, f"32 to fine={self.fine} pixels"),
            ("border", 0 < self.border < 0.25, "a share within (0, 0.25)"),
            ("colours", 1 <= self.colours <= 16, "1 to 16"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("smooth", self.smooth > 0, "more than 0"),
            ("texture", self.texture >= 0, "at least 0"),
            ("centre", self.centre > 0, "more than 0"),
            ("contrast", self.contrast > 0, "more than 0"),
            ("clear", 0 <= self.clear <= self.sure <= 1, f"0 to sure={self.sure}, which is at most 1"),
        ):
            if not possible:
                raise ConfigError(f"cutout.{key}={getattr(self, key)}: expected {expected}")

    def find(self, path: str | Path) -> Mask:
        """Find the object of a picture.

        Raises:
            DataError: the picture cannot be read, or nothing stands out from its border.
            ConfigError: weights that are not there, or cannot be used; a box that is none of the picture's.
        """
        pixels, _ = decode_with_alpha(Path(path), upright=True)
        window, within = self._window(pixels.shape[:2])
        name, doubts = self._network(), []
        where = np.zeros(pixels.shape[:2], bool)
        if name is None:
            where[window], doubts = self._by_colour(path, pixels[window], within)
            how = "by its colours, without a network"
        else:
            where[window] = _by_network(pixels[window], name, self.weights)
            how = f"by rembg's {name}"
        if within is not None:
            where[window] &= within
        where = _main_part(where)
        return Mask(where, how, (*_doubts(path, where, self.box is not None), *doubts))

    def _window(self, shape: tuple[int, int]) -> tuple[tuple[slice, slice], Bool[np.ndarray, "rows columns"] | None]:
        """Return the part of a picture that is looked at, and where in it the box is."""
        if self.box is None:
            return (slice(None), slice(None)), None
        check_box(self.box, *shape)
        left, top, right, bottom = (round(edge) for edge in self.box)
        where = np.zeros(shape, bool)
        where[top:bottom, left:right] = True
        window = _around(where)
        return window, where[window]

    def _network(self) -> str | None:
        if self.weights is not None:
            if not Path(self.weights).is_file():
                raise ConfigError(f"cutout.weights={self.weights}: no such file; give the ONNX file of a network")
            return "u2net_custom"
        folder = Path(os.environ.get("U2NET_HOME", Path.home() / ".u2net"))
        return next((name for name in NETWORKS if (folder / f"{name}.onnx").is_file()), None)

    def _by_colour(
        self, path: str | Path, pixels: UInt8[np.ndarray, "height width 3"], within: Bool[np.ndarray, "h w"] | None
    ) -> tuple[Bool[np.ndarray, "height width"], list[str]]:
        """Return where the object is, and in words why that may be wrong."""
        doubts = []
        if within is not None:
            found = self._fine(pixels, self._closer(pixels, within, 1.0)) & within
        else:
            self._refuse_narrow(path, pixels.shape[:2])
            first = self._best(pixels)
            doubts = first.doubts(self)
            if first.score < self.clear:
                raise DataError(f"{path}: no object stands out from the background ({'; '.join(doubts)}). {GIVE}")
            found = self._fine(pixels, first.share)
        if found.any():
            window = _around(found)
            closer = self._fine(pixels[window], self._closer(pixels[window], found[window], 0.0))
            if closer.sum() > found.sum() / 2:
                found = np.zeros_like(found)
                found[window] = closer
        return found, doubts

    def _band(self, longer: int) -> int:
        """Return the border's pixels of a shrunken picture."""
        return max(2, round(self.border * longer))

    def _refuse_narrow(self, path: str | Path, shape: tuple[int, int]) -> None:
        """Raise DataError where the border leaves no room for an object."""
        longer = max(shape)
        least = math.ceil((2 * self._band(min(longer, self.side)) + 4) * max(1.0, longer / self.side))
        if min(shape) < least:
            raise DataError(
                f"{path}: {shape[1]}x{shape[0]} pixels (width x height) are too few to find an object in; its shorter "
                f"side needs at least {least}. Give a larger picture, or one with more around the object"
            )

    def _fine(self, pixels, share) -> Bool[np.ndarray, "height width"]:
        return _main_part(refined(pixels, share, self.fine))

    def _closer(self, pixels, found, margin: float) -> Float[np.ndarray, "rows columns"]:
        """Return the share of the object in each pixel. It lies within, or near, the hull of `found`.

        Args:
            margin: how deep within the hull the object is as likely as not, in tenths of its size.
        """
        lab = self._lab(pixels)
        hull = convex_hull_image(np.asarray(Image.fromarray(found).resize(lab.shape[1::-1])))
        reach = 0.1 * np.sqrt(hull.sum())
        inside, outside = (ndimage.distance_transform_edt(part) / reach for part in (hull, ~hull))
        enclosed = (np.where(hull, (inside - margin).clip(-1, 1.5), 0) - outside.clip(0, 4)).ravel()
        return self._cut(RandomWalk(lab, self.smooth, 0.0), lab, enclosed, np.zeros(hull.shape, bool))

    def _lab(self, pixels) -> Float[np.ndarray, "rows columns 3"]:
        return ndimage.gaussian_filter(rgb2lab(shrunk(pixels, self.side) / 255), (0.7, 0.7, 0))

    def _best(self, pixels: UInt8[np.ndarray, "height width 3"]) -> "_Reading":
        """Read a picture in both ways, and return the better reading."""
        lab = self._lab(pixels)
        height, width, _ = lab.shape
        band = self._band(max(height, width))
        edge = np.ones((height, width), bool)
        edge[band:-band, band:-band] = False
        down, right = np.mgrid[:height, :width]
        offset = ((down + 0.5) / height * 2 - 1.1) ** 2 + ((right + 0.5) / width * 2 - 1) ** 2
        centred = np.exp(-offset / (2 * self.centre**2))
        readings = []
        for texture, prior in ((0.0, np.ones_like(centred)), (self.texture, centred)):
            share = self._read(lab, edge, texture, prior)
            readings.append(_Reading.of(lab, share, centred, self.contrast))
        return max(readings, key=lambda reading: reading.score)

    def _read(self, lab, edge, texture: float, prior) -> Float[np.ndarray, "rows columns"]:
        """Return the share of the object in each pixel."""
        walk, prior = RandomWalk(lab, self.smooth, texture), prior.ravel()
        # to begin with, the object is what no path from the border reaches without crossing edges
        crossed = np.log1p(walk.crossed(edge)) * prior
        between = threshold_otsu(crossed[~edge.ravel()])
        enclosed = (6 * (crossed - between)).clip(-4, 4) + 2 * np.log(prior)
        return self._cut(walk, lab, enclosed, edge)

    def _cut(self, walk: "RandomWalk", lab, enclosed, edge) -> Float[np.ndarray, "rows columns"]:
        """Learn colours and cut along edges by turns; `enclosed` are each pixel's own log-odds of the object."""
        learnt = lab.reshape(-1, 3)
        found = walk.cut(1 / (1 + np.exp(-enclosed)))
        for _ in range(self.rounds):
            inner = found > 0.5
            if inner.sum() < 20 or (~inner).sum() < 20:
                break
            object_, behind = Mixture.of(learnt[inner], self.colours), Mixture.of(learnt[~inner], self.colours)
            difference = (object_.log_density(learnt) - behind.log_density(learnt)).clip(-4, 4)
            share = 1 / (1 + np.exp(-difference - enclosed))
            share[edge.ravel()] = np.minimum(share[edge.ravel()], 0.2)  # an object may touch the border, hardly fill it
            found = walk.cut(share)
        return found.reshape(edge.shape)


@dataclass(frozen=True)
class _Reading:
    """Hold where a shrunken picture was found to show an object, and how clearly.

    Args:
        share: of the object in each pixel.
        outline: share of the main part's outline across which colours change.
        place: how usual its place is: 1 in the middle.
        area: share of the picture.
        others: area of the next part that stands out against the main one's.
    """

    share: Float[np.ndarray, "rows columns"]
    outline: float
    place: float
    area: float
    others: float

    @staticmethod
    def of(lab, share, centred, contrast: float) -> "_Reading":
        parts, count = ndimage.label(share > 0.5)
        sizes = np.sort(np.bincount(parts.ravel(), minlength=2)[1:])[::-1]
        if count == 0 or sizes[0] < 20:
            return _Reading(share, 0.0, 0.0, 0.0, 0.0)
        where = _main_part(share > 0.5)
        inner, outer = ndimage.binary_erosion(where), ~ndimage.binary_dilation(where)
        changes = np.linalg.norm(_nearby(lab, inner) - _nearby(lab, outer), axis=-1)[where & ~inner]
        middle = tuple(round(at) for at in ndimage.center_of_mass(where))
        others = float(sizes[1] / sizes[0]) if count > 1 else 0.0
        return _Reading(share, float((changes > contrast).mean()), float(centred[middle]), float(where.mean()), others)

    @property
    def score(self) -> float:
        return self.outline**2 * self.place * min(1.0, self.area / SMALL)

    def doubts(self, limits: CutOut) -> list[str]:
        """List in words why this reading may be wrong."""
        found = []
        if self.score < limits.sure and self.outline**2 <= self.place:
            found.append(f"only {self.outline:.0%} of its outline is an edge of colours")
        elif self.score < limits.sure and self.area >= SMALL:
            found.append("it lies far from the middle")
        elif self.score < limits.sure:
            found.append(f"only {self.area:.1%} of the picture does")
        if self.others > limits.others:
            found.append("another part of the picture stands out as well")
        return found


def _nearby(lab, where) -> Float[np.ndarray, "rows columns 3"]:
    """Return the mean colours of a part around each pixel."""
    near = ndimage.gaussian_filter(where.astype(float), 2) + 1e-6
    return np.stack([ndimage.gaussian_filter(lab[..., c] * where, 2) / near for c in range(3)], -1)


def _by_network(
    pixels: UInt8[np.ndarray, "height width 3"], name: str, weights: str | Path | None
) -> Bool[np.ndarray, "height width"]:
    try:
        import rembg
    except ImportError as error:
        raise ConfigError("a network's weights are there, but rembg is not: pip install 'rembg[cpu]'") from error
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


def _doubts(path: str | Path, where: Bool[np.ndarray, "height width"], boxed: bool = False) -> tuple[str, ...]:
    border = np.ones(where.shape, bool)
    border[1:-1, 1:-1] = False
    area, touched = where.mean(), where[border].mean()
    if area < 0.002 or area > 0.9 or touched > 0.5:
        raise DataError(
            f"{path}: no object stands out from the background (the mask covers {area:.1%} of the picture and "
            f"{touched:.0%} of its border). {GIVE}"
        )
    doubts = []
    if touched > 0.02:
        doubts.append(f"it touches {touched:.0%} of the picture's border")
    if area < SMALL and not boxed:
        doubts.append(f"it covers only {area:.1%} of the picture")
    if area > 0.7:
        doubts.append(f"it covers {area:.0%} of the picture")
    return tuple(doubts)


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
