"""The rays of all virtual views with the colours they should have, to be sampled at random."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64, Shaped
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
        self.shape, self._size = (scenes, per_scene), rays.directions.shape[-3:-1]
        self._views: Int64[Tensor, "scenes chosen"] | None = None
        bounds = [bound.expand(rays.directions.shape[:-1])[..., None] for bound in (rays.near, rays.far)]
        colours = torch.zeros_like(rays.directions)
        # One row per ray, so that sampling is one gather: origin, direction, colour, near, far.
        table = torch.cat([rays.origins.expand_as(colours), rays.directions, colours, *bounds], -1)
        self._table = table.reshape(scenes * per_scene, -1)
        self._coarse: Float[Tensor, "rays bins"] | None = None
        self._weights: Tensor | None = None  # of each ray
        self._upto: Float[Tensor, "scenes rays"] | None = None  # shares of the rays before each, and its own
        self._first = per_scene * torch.arange(scenes, device=near.device)[:, None]

    def set_colours(self, images: Float[Tensor, "scenes views 3 height width"]) -> None:
        """Set the colours that the rays should have, from images in [0, 1], one per camera."""
        self._table[:, 6:9] = images.movedim(2, -1).reshape(-1, 3)

    def set_weights(self, weights: Float[Tensor, "scenes views height width"]) -> None:
        """Set how much the rays weigh in the loss."""
        self._weights = _kept(self._weights, weights.reshape(-1))

    def set_shares(self, shares: Float[Tensor, "scenes views height width"]) -> None:
        """Set in which proportion `draw` draws the rays of all views."""
        # in double: float32 has too few digits for the sum of millions
        self._upto = shares.flatten(1).double().cumsum(1)

    def set_coarse(self, coarse: Float[Tensor, "scenes views height width bins"]) -> None:
        """Keep the coarse weights of the chosen views' rays (`Rendering.coarse`), for `coarse_at` to return."""
        if self._views is not None:
            height, width = self._size
            before = self._coarse if self._coarse is not None else coarse.new_zeros(len(self._table), coarse.shape[-1])
            every = before.reshape(self.shape[0], -1, height, width, coarse.shape[-1])
            coarse = with_views(every, self._views, coarse)
        self._coarse = _kept(self._coarse, coarse.reshape(len(self._table), -1))

    def set_views(self, views: Int64[Tensor, "scenes chosen"] | None) -> None:
        """Choose the views from which `draw` draws; None is all."""
        self._views = views

    def draw(
        self, side: int, patches: Int64[Tensor, "scenes *shape"], generators: Sequence[torch.Generator]
    ) -> Int64[Tensor, "scenes ..."]:
        """Draw square patches of rays of the chosen views, anywhere within them, with replacement.

        Args:
            side: of a patch, in pixels; 1 draws single rays.
            patches: memory for as many numbers as there are patches to draw.
            generators: of each scene.

        Returns:
            the numbers of their rays within their scenes, patch by patch, row by row.
        """
        if self._upto is not None:
            for own, upto, source in zip(patches, self._upto, generators, strict=True):
                places = torch.rand(own.shape, generator=source, device=own.device, dtype=torch.float64) * upto[-1]
                own.copy_(torch.searchsorted(upto, places, right=True).clamp_max(len(upto) - 1))
            return patches
        height, width = self._size
        rows, columns = height - side + 1, width - side + 1
        views = self.shape[1] // (height * width) if self._views is None else self._views.shape[1]
        for own, source in zip(patches, generators, strict=True):
            own.random_(views * rows * columns, generator=source)
        view = patches // (rows * columns)
        if self._views is not None:
            view = self._views.gather(1, view.flatten(1)).reshape(view.shape)
        first = (view * height + patches // columns % rows) * width + patches % columns
        steps = torch.arange(side, device=first.device)
        return (first[..., None] + (width * steps[:, None] + steps).flatten()).flatten(-2)

    @property
    def largest_patch(self) -> int:
        """Side in pixels of the largest square patch."""
        return min(self._size)

    def at(self, picked: Int64[Tensor, "scenes n"]) -> tuple[Rays, Float[Tensor, "scenes n 3"]]:
        """Return rays by their numbers within their scenes, and their colours."""
        rows = self._table[picked + self._first]
        origins, directions, colours, near, far = rows.split([3, 3, 3, 1, 1], -1)
        return Rays(origins, directions, near[..., 0], far[..., 0]), colours

    def coarse_at(self, picked: Int64[Tensor, "scenes n"]) -> Float[Tensor, "scenes n bins"] | None:
        """Return the kept coarse weights of those rays; None where none were kept."""
        return None if self._coarse is None else self._coarse[picked + self._first]

    def weights_at(self, picked: Int64[Tensor, "scenes n"]) -> Float[Tensor, "scenes n"] | None:
        """Return how much those rays weigh; None where they all weigh the same."""
        return None if self._weights is None else self._weights[picked + self._first]


def with_views(
    every: Shaped[Tensor, "scenes views *rest"],
    views: Int64[Tensor, "scenes chosen"],
    values: Shaped[Tensor, "scenes chosen *rest"],
) -> Shaped[Tensor, "scenes views *rest"]:
    """Return `every` with some views' entries replaced. (Not by `index_put`, which autocast refuses halves.)"""
    rows = views + every.shape[1] * torch.arange(len(every), device=every.device)[:, None]
    return every.flatten(0, 1).index_copy(0, rows.flatten(), values.flatten(0, 1)).reshape(every.shape)


def _kept(before: Tensor | None, values: Tensor) -> Tensor:
    """Return values in the memory of those before, which recorded steps read."""
    return values.clone() if before is None else before.copy_(values)
