"""Strategy `cdm`: every view sampled from the CDM by itself ("Ours (CDM)" in the paper's figures)."""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.ddim import ddim_sample, time_steps
from nerfdiff.distill.strategy import Views
from nerfdiff.field.encoder import Encoding
from nerfdiff.model import NerfDiff
from nerfdiff.randomness import generator


@dataclass(frozen=True)
class IndependentViews:
    """DDIM for each view, conditioned on the single-image NeRF's rendering of it. Not 3D consistent.

    Args:
        steps: DDIM steps (paper: 64).
        t_max, t_min: times where sampling starts and ends.
        eta: DDIM's η; 0 is deterministic given the initial noise.
        views_at_once: views denoised in one batch, which bounds memory.
    """

    name: str
    steps: int
    t_max: float
    t_min: float
    eta: float
    views_at_once: int

    @torch.no_grad()
    def predict(self, model: NerfDiff, scene: ViewBatch, seed: int) -> Views:
        encoding = model.encode(scene.source, scene.source_cameras, scene.near, scene.far)
        images = self.sample(model, encoding, scene.target_cameras, (seed, "cdm", *scene.scene_ids))[0]
        return Views(
            images=images,
            denoiser_calls=self.steps * len(images),
            field_queries=model.renderer.samples_per_ray * images[:, 0].numel(),
        )

    @torch.no_grad()
    def sample(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, seed: tuple[int | str, ...]
    ) -> Float[Tensor, "1 views 3 height width"]:
        """Images in [0, 1] of `cameras` [1, views], given in the input camera's space.

        Args:
            seed: a view's noise depends on it and on the view's position, not on what is sampled beside it.
        """
        device = encoding.source.device
        times = time_steps(self.steps, self.t_max, self.t_min, device=device)
        images = []
        for start in range(0, cameras.shape[1], self.views_at_once):
            chunk = cameras[:, start : start + self.views_at_once]
            condition = model.condition(encoding, chunk, model.render(encoding, chunk))
            sources = [generator(device, *seed, start + view) for view in range(chunk.shape[1])]
            noise = partial(_noise, sources, condition.rendered.shape[1:])
            x0 = ddim_sample(lambda z, t, c=condition: model.denoise(z, t, c), noise(), times, self.eta, noise)
            images.append((0.5 * (x0 + 1)).clamp(0, 1))
        return torch.cat(images)[None]


def _noise(sources: list[torch.Generator], shape: torch.Size) -> Float[Tensor, "views 3 height width"]:
    return torch.stack([torch.randn(shape, generator=source, device=source.device) for source in sources])
