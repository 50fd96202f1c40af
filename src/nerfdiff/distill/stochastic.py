"""Stochastic conditioning (3DiM, Watson et al. 2022, arXiv 2210.04628), on a CDM conditioned on renderings."""

from itertools import pairwise

import torch

from nerfdiff.diffusion.denoiser import Condition
from nerfdiff.diffusion.sampler import SamplerSettings
from nerfdiff.distill.direct import FixedTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.field.encoder import Encoding
from nerfdiff.utils.config import from_keys
from nerfdiff.utils.images import to_unit
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.timing import timed


@from_keys(sampling=SamplerSettings)
class StochasticTeacher(FixedTeacher):
    """Sample views one after another; condition each diffusion step on one of those made before.

    3DiM's network takes a conditioning image and the relative pose. Ours takes a rendering and an encoder's features;
    so to condition view k on view j, image j is encoded by itself, the resulting single-image NeRF rendered from
    camera k relative to camera j, and its features attended to. At each step of view k, j is drawn from the input and
    the views 0 … k − 1. The field is then fitted to the views, as in direct distillation.

    Args:
        views: to sample, in their order.
        steps: see `FixedTeacher`.
        sampler_steps: diffusion steps.
        sampling: all but `deep`: the condition changes from step to step, and deep features with it.

    Raises:
        ConfigError: a sampler, spacing, times or eta that cannot be.
    """

    @torch.no_grad()
    def __init__(self, views: VirtualViews, steps: int, sampler_steps: int, sampling: SamplerSettings):
        model, encodings = views.model, [views.encoding]
        frustum = views.encoding.triplane
        choice = generator("cpu", *views.seed, "stochastic conditioning")
        times = sampling.times(sampler_steps, views.encoding.source.device)
        images = []
        for view in range(len(views)):
            conditions: dict[int, Condition] = {}
            sampler = sampling.begin()
            z = views.noise_of(view)[None]
            for t, t_next in pairwise(times):
                # choose a condition among the input and the views before
                known = int(torch.randint(len(encodings), (), generator=choice))
                if known not in conditions:
                    conditions[known] = _condition(views, encodings[known], known, view)
                    views.field_queries += model.renderer.samples_per_ray * z[0, 0].numel()
                # denoise, and step to the next time
                with timed("denoise"):
                    x0 = model.denoiser(z, t[None], conditions[known]).clamp(-1, 1)
                views.denoiser_calls += 1
                z = sampler.step(z, x0, t, t_next, views.noise_of(view)[None] if sampler.needs_noise else None)
            # encode the view, for the later ones to be conditioned on
            images.append(to_unit(x0))
            encoded = model.encode_images(images[-1], frustum.cameras, frustum.near, frustum.far)
            encodings.append(model.with_keys_values(encoded))
        super().__init__(torch.cat(images), steps)


def _condition(views: VirtualViews, encoding: Encoding, known: int, view: int) -> Condition:
    """Make the condition of view `view` from a known image: 0 is the input, k + 1 is view k; `encoding` is its."""
    wanted = views.cameras[:, view : view + 1]
    if known > 0:
        wanted = wanted.relative_to(views.cameras[:, known - 1 : known])
    with timed("guide"):
        rendering = views.model.render(encoding, wanted)
    return views.model.condition(encoding, wanted, rendering.images)
