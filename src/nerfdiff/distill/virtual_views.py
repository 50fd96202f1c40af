"""K virtual views of one scene, and the frozen CDM that denoises them."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.deep_features import DeepFeatures, DeepReuse
from nerfdiff.diffusion.denoiser import Condition
from nerfdiff.field.encoder import Encoding
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.timing import timed

Images = Float[Tensor, "views 3 height width"]


class VirtualViews:
    """Hold the conditions and noise of K views, and denoise them in parts.

    Args:
        model: frozen.
        encoding: of the input image, computed once.
        cameras: [1, K], in the input camera's space.
        views_at_once: views denoised in one batch, which bounds memory.
        seed: of all noise; a view's noise depends on it and on the view's number alone.

    Raises:
        ConfigError: no views.
    """

    @torch.no_grad()
    def __init__(
        self, model: NerfDiff, encoding: Encoding, cameras: Cameras, views_at_once: int, seed: tuple[int | str, ...]
    ):
        if cameras.shape[1] < 1:
            raise ConfigError("there are no virtual views: set budget.views (or prior.views) to at least 1")
        self.model, self.cameras, self.seed = model, cameras, seed
        self.encoding = encoding = model.with_keys_values(encoding)
        self._parts = [slice(i, i + views_at_once) for i in range(0, cameras.shape[1], views_at_once)]
        self._conditions: list[Condition] = []
        for part in self._parts:
            chunk = cameras[:, part]
            with timed("guide"):
                rendering = model.render(encoding, chunk)
            self._conditions.append(model.condition(encoding, chunk, rendering.images))
        self._noise = [generator(encoding.source.device, *seed, view) for view in range(len(self))]
        self.denoiser_calls = 0
        self.field_queries = model.renderer.samples_per_ray * self.first_renderings[:, 0].numel()

    def __len__(self) -> int:
        return self.cameras.shape[1]

    @property
    def first_renderings(self) -> Images:
        """Images of all views by the single-image NeRF, in [0, 1]."""
        return torch.cat([condition.rendered for condition in self._conditions])

    def deep_features(self, deep: DeepReuse | None) -> list[DeepFeatures] | None:
        """Make room for reused features along one reverse process, for `denoise`; None where all is computed."""
        return None if deep is None or deep.every == 1 else [DeepFeatures(deep) for _ in self._parts]

    @timed("denoise")
    @torch.no_grad()
    def denoise(
        self,
        z: Images,
        t: Float[Tensor, "views"],
        rendered: Images | None = None,
        deep: Sequence[DeepFeatures] | None = None,
    ) -> Images:
        """Return x0 of every view, clamped to [-1, 1].

        Args:
            z: noised images Z_t.
            t: of each view.
            rendered: renderings that condition the CDM, in [0, 1]; None: the first renderings.
            deep: `deep_features`, where calls follow each other along one reverse process; None computes all.
        """
        self.denoiser_calls += len(z)
        x0 = []
        deep = [None] * len(self._parts) if deep is None else deep
        for part, condition, kept in zip(self._parts, self._conditions, deep, strict=True):
            if rendered is not None:
                condition = replace(condition, rendered=rendered[part])
            x0.append(self.model.denoiser(z[part], t[part], condition, kept))
        return torch.cat(x0).clamp(-1, 1)

    def noise(self) -> Images:
        """Draw standard normal images, each from its own view's stream."""
        return torch.stack([self.noise_of(view) for view in range(len(self))])

    def noise_of(self, view: int) -> Float[Tensor, "3 height width"]:
        """Draw a standard normal image from one view's stream."""
        source = self._noise[view]
        return torch.randn(self._conditions[0].rendered.shape[1:], generator=source, device=source.device)

    def uniform(self) -> Float[Tensor, "views"]:
        """Draw a number in [0, 1) for every view, from its own stream."""
        return torch.stack([torch.rand((), generator=g, device=g.device) for g in self._noise])
