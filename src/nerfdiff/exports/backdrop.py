"""Find matter of the background's colour in a field, and leave it out of meshes and pictures."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import label
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.exports.views import over, render_rgba
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BackdropSettings:
    """Hold the settings by which matter of the background's colour is found.

    A model that is trained before one background cannot tell matter of its colour from emptiness: fields have it under
    a car, or as a rim around it, and it shows as soon as the background is another. An object that is as light itself
    cannot be told from it: then all is kept.

    Args:
        views: cameras around the scene that look for it, beside the input camera; 0: it is kept.
        elevation: degrees above the horizon from and to, of these cameras.
        tolerance: difference of a pixel from the background that counts as none, where 1 is that of black and white.
        own_share: of the object's pixels in the input view that may be so light; with more, the object itself is.
        about: likewise of matter in the field, and of a mesh's colours; twice that in the rim of a patch.
        patch: share of all corners of a mesh that a patch of about that colour must have to take the colours beside it.
        rim: breadth of the rim, as a share of the mesh's longest side.

    Raises:
        ConfigError: values that are impossible.
    """

    views: int
    elevation: Sequence[float]
    tolerance: float
    own_share: float
    about: float
    patch: float
    rim: float

    def __post_init__(self):
        for key, possible, expected in (
            ("views", self.views >= 0, "at least 0"),
            (
                "elevation",
                len(self.elevation) == 2 and all(-90 < e < 90 for e in self.elevation),
                "[from, to]",
            ),
            ("tolerance", 0 <= self.tolerance < 1, "a share within [0, 1)"),
            ("own_share", 0 <= self.own_share <= 1, "a share within [0, 1]"),
            ("about", 0 <= self.about < 1, "a share within [0, 1)"),
            ("rim", self.rim >= 0, "at least 0"),
            ("patch", 0 <= self.patch <= 1, "a share within [0, 1]"),
        ):
            if not possible:
                raise ConfigError(f"mesh.backdrop.{key}={getattr(self, key)}: expected {expected}")

    def look(self, saved: SavedField, stands: Upright) -> "Backdrop | None":
        """Look at the scene from all around; None where there is nothing to be told from it."""
        if (background := saved.renderer.background) is None or self.views == 0:
            return None
        source, share = saved.field.cameras.to("cpu"), torch.arange(self.views) / self.views
        low, high = self.elevation
        cameras = Cameras.join([source, stands.around(source, 720 * share, low + (high - low) * share)])
        rgba = render_rgba(saved, cameras.to(saved.field.K.device), source.height)
        alike = _difference(over(rgba, background), background, 1) <= self.tolerance
        opaque = rgba[0, 3] > 0.5
        if (own := float((alike[0] & opaque).sum() / opaque.sum().clamp_min(1))) > self.own_share:
            log.warning(
                "%.0f %% of the object is as light as the background: what only repeats the background cannot be told "
                "from it, and is kept in meshes and pictures (mesh.backdrop.own_share=%g)",
                100 * own,
                self.own_share,
            )
            return None
        return Backdrop(self, background, cameras, torch.stack([joined_to_border(picture) for picture in alike]))


@dataclass(frozen=True)
class Backdrop:
    """Tell background, and what cannot be told from it, by what cameras around a scene see."""

    settings: BackdropSettings
    background: float
    cameras: Cameras
    seen: Bool[Tensor, "views height width"]

    def repeats(self, colours: Float[Tensor, "*points 3"]) -> Bool[Tensor, "*points"]:
        """Tell where colours of matter are about the background's."""
        return _difference(colours, self.background, -1) <= self.settings.about

    def alone(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Tell at which points of the input camera's space one camera at least sees background."""
        found = torch.zeros(len(points), dtype=torch.bool)
        size = torch.tensor([self.cameras.width, self.cameras.height])
        for view, seen in enumerate(self.seen):
            at = self.cameras[view : view + 1].project(points[None])[0][0].floor().long()
            within = ((at >= 0) & (at < size)).all(1)
            found[within] |= seen[at[within, 1], at[within, 0]]
        return found

    def painted_over(
        self, points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], faces: Int[np.ndarray, "m 3"]
    ) -> Float[Tensor, "n 3"]:
        """Return a mesh's colours, those of large patches of the background's as the mean of what lies beside them."""
        alike = self.repeats(colours).numpy()
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        edges = edges[alike[edges].all(1)]
        joined = coo_array((np.ones(len(edges), bool), tuple(edges.T)), shape=(len(points), len(points)))
        patches = connected_components(joined, directed=False)[1]
        large = np.bincount(patches) >= self.settings.patch * len(points)
        painted = alike & large[patches]
        if not painted.any():
            return colours
        rim = self.settings.rim * np.ptp(points.numpy(), axis=0).max()
        beside = np.isfinite(cKDTree(points[painted].numpy()).query(points.numpy(), distance_upper_bound=rim)[0])
        painted |= beside & (_difference(colours, self.background, -1) <= 2 * self.settings.about).numpy()
        if painted.all():
            return colours
        count = max(1, round(self.settings.patch * len(points)))
        beside = cKDTree(points[~painted].numpy()).query(points[painted].numpy(), min(count, (~painted).sum()))[1]
        colours = colours.clone()
        colours[painted] = colours[~painted][beside.reshape(painted.sum(), -1)].mean(1)
        return colours

    def cleared(self, rgba: Float[Tensor, "views 4 height width"]) -> Float[Tensor, "views 4 height width"]:
        """Make transparent what has the background's colour and reaches the border of a picture.

        There, and in a rim of a pixel of the field's own pictures around it, opacity is at most in proportion to the
        difference from the background. Before the background itself the pictures look as before.
        """
        picture, alpha = over(rgba, self.background), rgba[:, 3]
        difference = _difference(picture, self.background, 1)
        empty = torch.stack([joined_to_border(one) for one in difference <= self.settings.tolerance])
        reach = -(-rgba.shape[2] // self.cameras.height)
        near = F.max_pool2d(empty.float()[:, None], 2 * reach + 1, 1, reach)[:, 0] > 0
        limited = alpha.minimum(difference / (2 * self.settings.about))
        opacity = torch.where(near, limited, alpha)[:, None]
        own = (picture - (1 - opacity) * self.background) / opacity.clamp_min(1 / 255)
        return torch.cat([torch.where(opacity == alpha[:, None], rgba[:, :3], own.clamp(0, 1)), opacity], 1)


def _difference(colours: Tensor, background: float, channels: int) -> Tensor:
    return (colours - background).abs().amax(channels)


def joined_to_border(where: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Keep the parts that reach the picture's border."""
    parts = label(np.pad(where.numpy(), 1, constant_values=True), connectivity=1)
    return torch.from_numpy(parts == parts[0, 0])[1:-1, 1:-1]
