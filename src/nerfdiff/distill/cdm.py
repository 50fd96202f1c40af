"""Strategy `cdm`: every view sampled from the CDM by itself ("Ours (CDM)" in the paper's figures)."""

from dataclasses import dataclass

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
        images = []
        cameras = scene.target_cameras
        for start in range(0, cameras.shape[1], self.views_at_once):
            chunk = cameras[:, start : start + self.views_at_once]
            noise = generator(scene.source.device, seed, "cdm", scene.scene_ids[0], start)
            images.append(self.sample(model, encoding, chunk, noise)[0])
        images = torch.cat(images)
        return Views(
            images=images,
            denoiser_calls=self.steps * len(images),
            field_queries=model.renderer.samples_per_ray * images[:, 0].numel(),
        )

    @torch.no_grad()
    def sample(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, noise: torch.Generator
    ) -> Float[Tensor, "batch views 3 height width"]:
        """Images in [0, 1] of `cameras` [batch, views], given in the input cameras' space."""
        condition = model.condition(encoding, cameras, model.render(encoding, cameras))
        z = torch.randn(condition.rendered.shape, generator=noise, device=noise.device)
        times = time_steps(self.steps, self.t_max, self.t_min, device=z.device)
        x0 = ddim_sample(lambda z, t: model.denoise(z, t, condition), z, times, self.eta, noise)
        return (0.5 * (x0 + 1)).clamp(0, 1).unflatten(0, cameras.shape)
