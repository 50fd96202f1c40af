"""Random rays over all virtual views, with the colours they should have."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays


class RayBatches:
    """Rays of K cameras laid out in one row, and draws from it (paper: "rays with batch size B from all views").

    Args:
        cameras: [1, K], in the input camera's space.
        near, far: of the scene.
        images: targets in [0, 1], one per camera.
        generator: of the draws.
    """

    def __init__(
        self,
        cameras: Cameras,
        near: Float[Tensor, "1"],
        far: Float[Tensor, "1"],
        images: Float[Tensor, "views 3 height width"],
        generator: torch.Generator,
    ):
        rays = cameras.rays(near[:, None], far[:, None])
        shape = rays.directions.shape[:-1]
        self.rays = Rays(
            rays.origins.reshape(1, -1, 3),
            rays.directions.reshape(1, -1, 3),
            rays.near.expand(shape).reshape(1, -1),
            rays.far.expand(shape).reshape(1, -1),
        )
        self.colours = images.movedim(1, -1).reshape(1, -1, 3)
        self.generator = generator

    def draw(self, count: int, samples: int) -> tuple[Rays, Float[Tensor, "1 {count} 3"], Tensor]:
        """`count` random rays, their colours, and jitter for `samples` samples on each."""
        device = self.colours.device
        picked = torch.randint(self.colours.shape[1], (count,), generator=self.generator, device=device)
        rays = Rays(*(part[:, picked] for part in vars(self.rays).values()))
        jitter = torch.rand(1, count, samples, generator=self.generator, device=device)
        return rays, self.colours[:, picked], jitter
