"""Do the rays of points that look alike in two views meet?"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from skimage.feature import SIFT, match_descriptors
from torch import Tensor
from torch.nn.functional import interpolate

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Finding
from nerfdiff.utils.spread import spread


@dataclass(frozen=True)
class Matches:
    """The rays of SIFT matches between neighbouring views meet in front of both.

    The last resort, for photographs with neither depth nor silhouettes: it needs texture, and views near each other. It
    notices OpenGL axes, inverted poses and transposed rotations; images upside down or a wrong focal length only where
    the cameras move in more than one direction.

    Args:
        views: of a scene that are each compared with others.
        partners: how many those are, the least turned against it.
        max_side: pixels; larger images are reduced to it.
        max_ratio: of the distances to the best and to the second best descriptor (Lowe's test).
        max_error: pixels of the reduced image between a point and where the rays' meeting point projects.
        min_matches: below which nothing is said.
        min_agreement: share of the matches whose rays must meet.
        min_turn: degrees between two views' axes, or their baseline over `far` times 57.3: views that are nearly the
            same have rays that meet wherever rounding has them.
        max_turn: degrees between two views' axes: SIFT does not match what is seen from elsewhere.
    """

    views: int
    partners: int
    max_side: int
    max_ratio: float
    max_error: float
    min_matches: int
    min_agreement: float
    min_turn: float
    max_turn: float
    tolerated: float

    measures: ClassVar[str] = "share of SIFT matches whose rays meet"
    higher_is_better: ClassVar[bool] = True
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = True
    tells_focal: ClassVar[bool] = True
    fallback: ClassVar[bool] = True

    def __call__(self, scene: Scene) -> Finding:
        pairs = self._pairs(scene)
        cameras, images = self._reduced(scene)
        features = {view: _features(images[view]) for pair in pairs for view in pair}
        met = total = 0
        for a, b in pairs:
            (points_a, words_a), (points_b, words_b) = features[a], features[b]
            if not len(points_a) or not len(points_b):
                continue
            found = match_descriptors(words_a, words_b, max_ratio=self.max_ratio, cross_check=True)
            matched = torch.from_numpy(points_a[found[:, 0]]), torch.from_numpy(points_b[found[:, 1]])
            error = reprojection_error(cameras[a], cameras[b], *matched)
            met += (error <= self.max_error).sum().item()
            total += len(error)
        if total < self.min_matches:
            return Finding.unchecked(
                f"no depth, no silhouettes, and neighbouring views have few points in common ({total} SIFT matches)"
            )
        share = met / total
        reason = None
        if share < self.min_agreement:
            reason = f"the rays of only {share:.0%} of {total} SIFT matches meet in front of the cameras"
        return Finding.judged(share, reason)

    def _pairs(self, scene: Scene) -> list[tuple[int, int]]:
        """Each view with those whose axes are turned least against its own, where that suits."""
        cameras = scene.cameras.to(torch.float64)
        forward = cameras.c2w[:, :3, 2]
        angles = torch.rad2deg(torch.acos((forward @ forward.mT).clamp(-1, 1)))
        baselines = torch.rad2deg(torch.cdist(cameras.centres, cameras.centres) / scene.far)
        angles[(torch.maximum(angles, baselines) < self.min_turn) | (baselines == 0)] = torch.inf
        pairs = set()
        for view in spread(len(cameras), self.views):
            for other in angles[view].argsort()[: self.partners].tolist():
                if angles[view, other] <= self.max_turn:
                    pairs.add((min(view, other), max(view, other)))
        return sorted(pairs)

    def _reduced(self, scene: Scene) -> tuple[Cameras, Float[Tensor, "views h w"]]:
        cameras, grey = scene.cameras.to(torch.float64), scene.images.mean(1)
        scale = self.max_side / max(cameras.height, cameras.width)
        if scale >= 1:
            return cameras, grey
        size = round(cameras.height * scale), round(cameras.width * scale)
        return cameras.resized(*size), interpolate(grey[:, None], size, mode="area")[:, 0]


def _features(image: Float[Tensor, "h w"]) -> tuple[Float[np.ndarray, "n 2"], np.ndarray]:
    """(u, v) with pixel centres at +0.5, and descriptors; none where the image has no features."""
    sift = SIFT()
    try:
        sift.detect_and_extract(image.numpy())
    except RuntimeError:  # skimage's way of saying that there are none
        return np.zeros((0, 2)), np.zeros((0, 128))
    return sift.positions[:, ::-1].astype(np.float64) + 0.5, sift.descriptors


def reprojection_error(
    a: Cameras, b: Cameras, points_a: Float[Tensor, "n 2"], points_b: Float[Tensor, "n 2"]
) -> Float[Tensor, " n"]:
    """Pixels from each point to where the meeting point of its ray and its partner's projects; the larger of two.

    Infinite where the rays meet behind a camera. (Epipolar lines alone would not tell: for cameras that move sideways
    they are nearly the same with axes reversed.)

    Args:
        a, b: single cameras.
    """
    rays_a, rays_b = _directions(a, points_a), _directions(b, points_b)
    between = b.centres - a.centres
    cosine = (rays_a * rays_b).sum(1)
    along_a, along_b = rays_a @ between, rays_b @ between
    across = (1 - cosine.square()).clamp_min(1e-12)
    s, t = (along_a - cosine * along_b) / across, (cosine * along_a - along_b) / across
    meeting = (a.centres + s[:, None] * rays_a + b.centres + t[:, None] * rays_b) / 2
    errors = []
    for camera, points in ((a, points_a), (b, points_b)):
        pixels, depth = camera.project(meeting)
        errors.append(torch.where(depth > 0, (pixels - points).norm(dim=1), torch.inf))
    return torch.where((s > 0) & (t > 0), torch.maximum(*errors), torch.inf)


def _directions(camera: Cameras, points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Unit directions of the rays through pixels."""
    local = torch.linalg.solve(camera.K, torch.nn.functional.pad(points, (0, 1), value=1.0).T)
    return torch.nn.functional.normalize((camera.c2w[:3, :3] @ local).T, dim=1)
