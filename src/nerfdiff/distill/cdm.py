"""Strategy `cdm`: every view sampled from the CDM by itself ("Ours (CDM)" in the paper's figures)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.deep_features import DeepReuse
from nerfdiff.diffusion.sampler import make_sampler, sample, time_steps
from nerfdiff.distill.strategy import Views
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.field.encoder import Encoding
from nerfdiff.model import NerfDiff
from nerfdiff.utils.images import to_unit


def sample_views(
    views: VirtualViews,
    steps: int,
    t_max: float,
    t_min: float,
    spacing: str,
    sampler: str,
    eta: float,
    deep: DeepReuse | None = None,
) -> Images:
    """Each view sampled, conditioned on the single-image NeRF's rendering of it: images in [0, 1]. Not 3D consistent.

    Args:
        steps: diffusion steps (paper: 64).
        t_max, t_min: times where sampling starts and ends.
        spacing: of the times between, `uniform_t` or `uniform_lambda`.
        sampler: `ddim` or `dpmpp_2m`.
        eta: DDIM's η; 0 is deterministic given the initial noise.
        deep: how often the CDM's deep levels are computed; None: at each step.

    Raises:
        ConfigError: another sampler or spacing, or times or an eta that cannot be.
    """
    times = time_steps(steps, t_max, t_min, spacing, device=views.encoding.source.device)
    run, kept = make_sampler(sampler, eta), views.reusing(deep)
    x0 = sample(lambda z, t: views.denoise(z, t.expand(len(z)), deep=kept), views.noise(), times, run, views.noise)
    return to_unit(x0)


@dataclass(frozen=True)
class IndependentViews:
    """The views to predict, as `sample_views` makes them.

    Args:
        steps, t_max, t_min, spacing, sampler, eta, deep: as there.
        views_at_once: views denoised in one batch, which bounds memory.
    """

    name: str
    steps: int
    t_max: float
    t_min: float
    spacing: str
    sampler: str
    eta: float
    views_at_once: int
    deep: DeepReuse | None = None

    @torch.no_grad()
    def predict(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[Views]:
        predicted = []
        for scene in scenes:
            encoding = model.encode(scene)
            images = self.sample(model, encoding, scene.target_cameras, (seed, "cdm", *scene.scene_ids))[0]
            rendered = model.renderer.samples_per_ray * images[:, 0].numel()  # the CDM's condition
            predicted.append(Views(images, denoiser_calls=self.steps * len(images), field_queries=rendered))
        return predicted

    @torch.no_grad()
    def sample(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, seed: tuple[int | str, ...]
    ) -> Float[Tensor, "1 views 3 height width"]:
        """Images in [0, 1] of `cameras` [1, views], given in the input camera's space.

        Args:
            seed: a view's noise depends on it and on the view's position, not on what is sampled beside it.
        """
        views = VirtualViews(model, encoding, cameras, self.views_at_once, seed)
        how = self.steps, self.t_max, self.t_min, self.spacing, self.sampler, self.eta, self.deep
        return sample_views(views, *how)[None]
