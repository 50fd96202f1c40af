"""Are the silhouettes those of one object?"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.morphology import convex_hull_image
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, max_pool2d

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Finding
from nerfdiff.utils.spread import spread


@dataclass(frozen=True)
class Silhouettes:
    """Along the ray of every foreground pixel there is a point that all other silhouettes hold: the visual hull.

    Silhouettes are the convex hulls of masks and of what differs from the background: the convex hull of an object
    projects onto the convex hull of its silhouette, and parts in the background's colour do not show as holes. A wrong
    focal length alone shrinks or grows the hull, which this does not notice.

    Args:
        background: grey level behind the object; null where there is none, and only masks serve.
        contrast: least difference from it that is an object, out of 1.
        views: of a scene that are compared.
        max_side: pixels; larger silhouettes are reduced to it.
        max_samples: points along a ray; neighbours are a pixel apart or less where they suffice.
        pixels: foreground pixels of each view that are looked at.
        dilate: pixels by which silhouettes are widened, for rounding and anti-aliasing.
        max_border: share of the images' outermost pixels that may be foreground.
        min_coverage: share of the foreground pixels that must be covered by the hull.
        seed: of the pixels.
    """

    background: float | None
    contrast: float
    views: int
    max_side: int
    max_samples: int
    pixels: int
    dilate: int
    max_border: float
    min_coverage: float
    seed: int
    tolerated: float

    measures: ClassVar[str] = "share of the silhouettes that their visual hull covers"
    higher_is_better: ClassVar[bool] = True
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = True
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        views = spread(len(scene.views), self.views)
        masks = self._foreground(scene, views)
        if masks is None:
            return Finding.unchecked("no masks, and no plain background (data.background is null)")
        kept = masks.flatten(1).any(1)
        views, masks = [view for view, keep in zip(views, kept.tolist(), strict=True) if keep], masks[kept]
        if len(views) < 3:
            return Finding.unchecked("fewer than three views with anything in them that differs from the background")
        border = _border(masks)
        if border.double().mean() > self.max_border:
            return Finding.unchecked("what differs from the background runs out of the images: no silhouettes")
        scale = min(1.0, self.max_side / max(masks.shape[1:]))
        masks = adaptive_max_pool2d(masks.float(), [max(1, round(side * scale)) for side in masks.shape[1:]]) > 0
        cameras = scene.cameras[views].resized(*masks.shape[1:]).to(torch.float64)
        coverage = self._coverage(cameras, _convex(masks), border.any(1), scene.near, scene.far)
        reason = None
        if coverage < self.min_coverage:
            reason = (
                f"the silhouettes are not those of one object: their visual hull covers only {coverage:.1%} of them"
            )
        return Finding.judged(coverage, reason)

    def _foreground(self, scene: Scene, views: list[int]) -> Bool[Tensor, "views h w"] | None:
        """Mark pixels that differ from the background, or the mask, or both: masks know parts in the background's
        colour, colours know parts thinner than a pixel."""
        masks = None if scene.mask is None else scene.mask[views]
        if self.background is None:
            return masks
        differing = (scene.pixels[views].float() / 255 - self.background).abs().amax(1) > self.contrast
        if masks is None:
            return differing
        plain = _border(differing).double().mean() <= self.max_border
        return masks | differing if plain else masks

    def _coverage(
        self, cameras: Cameras, masks: Bool[Tensor, "views h w"], cut: Bool[Tensor, " views"], near: float, far: float
    ) -> float:
        """Share of foreground pixels on whose ray some point lies within all silhouettes.

        Args:
            cut: views whose silhouette the image's border cuts off, outside of which anything may be.
        """
        height, width = cameras.height, cameras.width
        size = 2 * self.dilate + 1
        wide = max_pool2d(masks[:, None].double(), size, stride=1, padding=self.dilate)[:, 0] > 0
        rays = cameras.rays(near, far)
        distances = self._distances(cameras, near, far)
        rng = np.random.default_rng(self.seed)
        covered = []
        for view in range(len(cameras)):
            pixels = masks[view].nonzero().numpy()
            y, x = pixels[rng.choice(len(pixels), min(self.pixels, len(pixels)), replace=False)].T
            points = rays.origins[view, y, x][:, None] + distances[:, None] * rays.directions[view, y, x][:, None]
            others = [other for other in range(len(cameras)) if other != view]
            uv, z = cameras[others].project(points.reshape(1, -1, 3))
            u, v = uv.nan_to_num(-1, -1, -1).clamp(-1, max(height, width)).floor().long().unbind(-1)
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            held = wide[torch.tensor(others)[:, None], v.clamp(0, height - 1), u.clamp(0, width - 1)]
            held = (z > 0) & torch.where(inside, held, cut[others][:, None])
            covered.append(held.all(0).reshape(len(y), -1).any(1))
        return torch.cat(covered).double().mean().item()

    def _distances(self, cameras: Cameras, near: float, far: float) -> Float[Tensor, " samples"]:
        """Near to far in equal ratios, which are equal steps in pixels for a view from the side as far away."""
        pixels = cameras.K[:, 0, 0].max().item() * math.log(far / near)
        samples = min(max(math.ceil(pixels), 2), self.max_samples)
        return torch.logspace(math.log10(near), math.log10(far), samples, dtype=torch.float64)


def _border(masks: Bool[Tensor, "views h w"]) -> Bool[Tensor, "views outermost"]:
    return torch.cat([masks[:, 0], masks[:, -1], masks[:, :, 0], masks[:, :, -1]], 1)


def _convex(masks: Bool[Tensor, "views h w"]) -> Bool[Tensor, "views h w"]:
    return torch.from_numpy(np.stack([convex_hull_image(mask) for mask in masks.numpy()]))
