"""Strategy `cdm`: every view sampled from the CDM by itself ("Ours (CDM)" in the paper's figures)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.sampler import SamplerSettings, sample
from nerfdiff.distill.autoguidance import Autoguidance
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.field.encoder import Encoding
from nerfdiff.model import NerfDiff
from nerfdiff.utils.config import from_keys
from nerfdiff.utils.images import to_unit


def sample_views(views: VirtualViews, steps: int, sampling: SamplerSettings) -> Images:
    """Sample each view, conditioned on the single-image NeRF's rendering of it. Views are not 3D consistent.

    Args:
        steps: diffusion steps (paper: 64).

    Returns:
        images in [0, 1].

    Raises:
        ConfigError: a sampler, spacing, times or eta that cannot be.
    """
    times, sampler = sampling.times(steps, views.encoding.source.device), sampling.begin()
    deep = views.deep_features(sampling.deep)
    x0 = sample(lambda z, t: views.denoise(z, t.expand(len(z)), deep=deep), views.noise(), times, sampler, views.noise)
    return to_unit(x0)


@from_keys(sampling=SamplerSettings)
@dataclass(frozen=True)
class CDMSampling:
    """Predict views as `sample_views` makes them.

    Args:
        steps: diffusion steps.
        views_at_once: views denoised in one batch, which bounds memory.
        autoguidance: by an earlier snapshot.
    """

    name: str
    steps: int
    sampling: SamplerSettings
    views_at_once: int
    autoguidance: Autoguidance | None = None

    @torch.no_grad()
    def predict(
        self, model: NerfDiff, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        """See `Strategy`."""
        predicted = []
        for scene in scenes:
            images = self.sample(model, model.encode(scene), scene.target_cameras, (seed, "cdm", *scene.scene_ids))[0]
            rendered = model.renderer.samples_per_ray * images[:, 0].numel()  # the CDM's condition
            calls = self.steps * len(images) * (2 if self.autoguidance is not None and self.autoguidance.on else 1)
            predicted.append(PredictedViews(images, denoiser_calls=calls, field_queries=rendered))
        return predicted

    @torch.no_grad()
    def sample(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, seed: tuple[int | str, ...]
    ) -> Float[Tensor, "1 views 3 height width"]:
        """Sample images in [0, 1] of `cameras` [1, views], given in the input camera's space.

        Args:
            seed: a view's noise depends on it and on the view's position, not on what is sampled beside it.
        """
        views = VirtualViews(model, encoding, cameras, self.views_at_once, seed)
        views.autoguide(self.autoguidance)
        return sample_views(views, self.steps, self.sampling)[None]
