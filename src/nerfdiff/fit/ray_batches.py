"""The rays of all virtual views with the colours they should have, to be sampled at random."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays


class RayBatches:
    """Lay out the rays of K cameras of each scene in one table (paper: "batch size B from all views").

    Args:
        cameras: [scenes, K], in the space of each scene's input camera.
        near, far: of each scene.
    """

    def __init__(self, cameras: Cameras, near: Float[Tensor, "scenes"], far: Float[Tensor, "scenes"]):
        rays = cameras.rays(near[:, None], far[:, None])
        scenes, per_scene = len(near), rays.directions[0, ..., 0].numel()
        self.shape = scenes, per_scene
        bounds = [bound.expand(rays.directions.shape[:-1])[..., None] for bound in (rays.near, rays.far)]
        colours = torch.zeros_like(rays.directions)
        # One row per ray, so that sampling is one gather: origin, direction, colour, near, far.
        table = torch.cat([rays.origins.expand_as(colours), rays.directions, colours, *bounds], -1)
        self._table = table.reshape(scenes * per_scene, -1)
        self._coarse: Float[Tensor, "rays bins"] | None = None
        self._first = per_scene * torch.arange(scenes, device=near.device)[:, None]

    def set_colours(self, images: Float[Tensor, "scenes views 3 height width"]) -> None:
        """Set the colours that the rays should have, from images in [0, 1], one per camera."""
        self._table[:, 6:9] = images.movedim(2, -1).reshape(-1, 3)

    def set_coarse(self, coarse: Float[Tensor, "scenes views height width bins"]) -> None:
        """Keep the coarse weights of all rays (`Rendering.coarse`), for `coarse_at` to return."""
        weights = coarse.reshape(len(self._table), -1)
        if self._coarse is None:
            self._coarse = weights.clone()
        else:
            self._coarse.copy_(weights)  # recorded steps read this memory

    def at(self, picked: Int64[Tensor, "scenes n"]) -> tuple[Rays, Float[Tensor, "scenes n 3"]]:
        """Return rays by their numbers within their scenes, and their colours."""
        rows = self._table[picked + self._first]
        origins, directions, colours, near, far = rows.split([3, 3, 3, 1, 1], -1)
        return Rays(origins, directions, near[..., 0], far[..., 0]), colours

    def coarse_at(self, picked: Int64[Tensor, "scenes n"]) -> Float[Tensor, "scenes n bins"] | None:
        """Return the kept coarse weights of those rays; None where none were kept."""
        return None if self._coarse is None else self._coarse[picked + self._first]
