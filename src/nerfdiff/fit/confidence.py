"""Confidence in the pixels of views by reprojection: where neighbouring views disagree, one of them is wrong."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.utils.errors import ConfigError


@dataclass(frozen=True)
class Confidence:
    """How much a pixel weighs in the loss, by how well the neighbouring views agree with it.

    Each pixel is placed in space at the field's depth and looked up in the views whose cameras are nearest. Its weight
    is exp(−e / scale), where e is the mean absolute difference of colours to those that see the place; a pixel that no
    neighbour sees weighs 1. Weights are then scaled to a mean of 1 over all pixels of a scene.

    Args:
        scale: difference of colours, in [0, 1], at which a weight is 1/e; None weighs all pixels the same.
        neighbours: views that each is compared with.
        tolerance: share of the distance by which a neighbour's depth may differ at a place that it sees; beyond it,
            something is in the way.

    Raises:
        ConfigError: a number that is not positive.
    """

    scale: float | None = None
    neighbours: int = 2
    tolerance: float = 0.05

    def __post_init__(self):
        for name in ("scale", "neighbours", "tolerance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"strategy.confidence.{name}={value} must be above 0")

    @property
    def on(self) -> bool:
        """True if pixels weigh differently."""
        return self.scale is not None

    def weights(
        self,
        images: Float[Tensor, "scenes views 3 height width"],
        depth: Float[Tensor, "scenes views height width"],
        cameras: Cameras,
    ) -> Float[Tensor, "scenes views height width"]:
        """Return the weights of all pixels of the views of cameras [scenes, views].

        Args:
            images: in [0, 1].
            depth: of the field, as distance along each ray.
        """
        size = depth.shape[-2:]
        one = depth.new_ones(())
        unit = cameras.rays(one, one)
        points = (unit.origins + unit.directions * depth[..., None]).flatten(2, 3)
        seen = torch.cat([images, depth[:, :, None]], 2)
        error, count = torch.zeros_like(depth), torch.zeros_like(depth)
        for other in _nearest(cameras.centres, self.neighbours).unbind(-1):
            theirs = Cameras(_of_view(cameras.c2w, other), _of_view(cameras.K, other), *size)
            pixels, z = theirs.project(points)
            place = torch.stack([2 * pixels[..., 0] / size[1] - 1, 2 * pixels[..., 1] / size[0] - 1], -1)
            looked_up = F.grid_sample(
                _of_view(seen, other).flatten(0, 1),
                place.reshape(-1, *size, 2),
                padding_mode="border",
                align_corners=False,
            ).reshape(seen.shape)
            distance = (points - theirs.centres[..., None, :]).norm(dim=-1)
            inside = ((place.abs() <= 1).all(-1) & (z > 0)).reshape(depth.shape)
            distance = distance.reshape(depth.shape)
            visible = inside & ((distance - looked_up[:, :, 3]).abs() <= self.tolerance * distance)
            error += torch.where(visible, (looked_up[:, :, :3] - images).abs().mean(2), 0.0)
            count += visible
        weights = torch.exp(-error / count.clamp_min(1) / self.scale)
        return weights / weights.flatten(1).mean(1)[:, None, None, None]


def _nearest(centres: Float[Tensor, "scenes views 3"], count: int) -> Int64[Tensor, "scenes views neighbours"]:
    """Return for each view the numbers of the views whose centres are nearest, itself left out."""
    views = centres.shape[1]
    apart = (centres[:, :, None] - centres[:, None]).norm(dim=-1)
    apart = apart + torch.zeros_like(apart[0]).fill_diagonal_(torch.inf)
    return apart.topk(min(count, views - 1), largest=False).indices


def _of_view(values: Tensor, view: Int64[Tensor, "scenes views"]) -> Tensor:
    """Take each scene's entries of these views."""
    rows = torch.arange(len(view), device=view.device)[:, None]
    return values[rows, view]
