"""3DiM's stochastic conditioning (Watson et al. 2022), on a CDM that is conditioned on renderings."""

from itertools import pairwise

import torch

from nerfdiff.diffusion.denoiser import Condition
from nerfdiff.diffusion.sampler import make_sampler, time_steps
from nerfdiff.distill.direct import FixedImages
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.field.encoder import Encoding
from nerfdiff.utils.images import to_unit
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.timing import timed


class AutoregressiveViews(FixedImages):
    """Views made one after another; each diffusion step is conditioned on one of those there are already.

    3DiM's network takes a conditioning image and the relative pose. Ours takes a rendering and an encoder's features;
    so to condition view k on view j, image j is encoded by itself, the resulting single-image NeRF rendered from
    camera k relative to camera j, and its features attended to. At each step of view k, j is drawn from the input and
    the views 0 … k − 1. The field is then fitted to the views, as in direct distillation.

    Args:
        views: to make, in their order.
        steps: how many times targets are asked for.
        sampler_steps: diffusion steps from `t_max` to `t_min`.
        spacing: of the times, `uniform_t` or `uniform_lambda`.
        sampler: `ddim` or `dpmpp_2m`.
        eta: DDIM's η.

    Raises:
        ConfigError: another sampler or spacing, or times or an eta that cannot be.
    """

    @torch.no_grad()
    def __init__(
        self,
        views: VirtualViews,
        steps: int,
        sampler_steps: int,
        t_max: float,
        t_min: float,
        spacing: str,
        sampler: str,
        eta: float,
    ):
        model, encodings = views.model, [views.encoding]
        frustum = views.encoding.triplane
        choice = generator("cpu", *views.seed, "stochastic conditioning")
        times = time_steps(sampler_steps, t_max, t_min, spacing, device=views.encoding.source.device)
        images = []
        for view in range(len(views)):
            conditions: dict[int, Condition] = {}
            run = make_sampler(sampler, eta)
            z = views.noise_of(view)[None]
            for t, t_next in pairwise(times):
                known = int(torch.randint(len(encodings), (), generator=choice))
                if known not in conditions:
                    conditions[known] = _condition(views, encodings[known], known, view)
                    views.field_queries += model.renderer.samples_per_ray * z[0, 0].numel()
                with timed("denoise"):
                    x0 = model.denoiser(z, t[None], conditions[known]).clamp(-1, 1)
                views.denoiser_calls += 1
                z = run.step(z, x0, t, t_next, views.noise_of(view)[None] if run.needs_noise else None)
            images.append(to_unit(x0))
            encoded = model.encode_images(images[-1], frustum.cameras, frustum.near, frustum.far)
            encodings.append(model.settled(encoded))  # seen by many steps of many views
        super().__init__(torch.cat(images), steps)


def _condition(views: VirtualViews, encoding: Encoding, known: int, view: int) -> Condition:
    """View `view` as seen from what is known: 0 is the input image, k + 1 is view k; `encoding` is its."""
    wanted = views.cameras[:, view : view + 1]
    if known > 0:
        wanted = wanted.relative_to(views.cameras[:, known - 1 : known])
    with timed("guide"):
        rendering = views.model.render(encoding, wanted)
    return views.model.condition(encoding, wanted, rendering.images)
