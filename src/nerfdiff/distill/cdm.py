"""Strategy `cdm`: every view sampled from the CDM by itself ("Ours (CDM)" in the paper's figures)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.ddim import ddim_sample, time_steps
from nerfdiff.distill.strategy import Views
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.field.encoder import Encoding
from nerfdiff.model import NerfDiff


def sample_views(views: VirtualViews, steps: int, t_max: float, t_min: float, eta: float) -> Images:
    """DDIM for each view, conditioned on the single-image NeRF's rendering of it: images in [0, 1]. Not 3D consistent.

    Args:
        steps: DDIM steps (paper: 64).
        t_max, t_min: times where sampling starts and ends.
        eta: DDIM's η; 0 is deterministic given the initial noise.
    """
    times = time_steps(steps, t_max, t_min, device=views.encoding.source.device)
    x0 = ddim_sample(lambda z, t: views.denoise(z, t.expand(len(z))), views.noise(), times, eta, views.noise)
    return 0.5 * (x0 + 1)


@dataclass(frozen=True)
class IndependentViews:
    """The views to predict, as `sample_views` makes them.

    Args:
        steps, t_max, t_min, eta: as there.
        views_at_once: views denoised in one batch, which bounds memory.
    """

    name: str
    steps: int
    t_max: float
    t_min: float
    eta: float
    views_at_once: int

    @torch.no_grad()
    def predict(self, model: NerfDiff, scene: ViewBatch, seed: int, callbacks: Sequence[Callback] = ()) -> Views:
        encoding = model.encode(scene.source, scene.source_cameras, scene.near, scene.far)
        images = self.sample(model, encoding, scene.target_cameras, (seed, "cdm", *scene.scene_ids))[0]
        return Views(
            images=images,
            denoiser_calls=self.steps * len(images),
            field_queries=model.renderer.samples_per_ray * images[:, 0].numel(),  # the CDM's condition
        )

    @torch.no_grad()
    def sample(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, seed: tuple[int | str, ...]
    ) -> Float[Tensor, "1 views 3 height width"]:
        """Images in [0, 1] of `cameras` [1, views], given in the input camera's space.

        Args:
            seed: a view's noise depends on it and on the view's position, not on what is sampled beside it.
        """
        views = VirtualViews(model, encoding, cameras, self.views_at_once, seed)
        return sample_views(views, self.steps, self.t_max, self.t_min, self.eta)[None]
