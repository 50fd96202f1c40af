"""K virtual views of one scene, and the frozen CDM that denoises them."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.deep_features import DeepFeatures, DeepReuse
from nerfdiff.diffusion.denoiser import Condition, Denoiser
from nerfdiff.distill.autoguidance import Autoguidance
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
        last: number of views that are left at the last step, see `choose`; None: all.

    `until` is where the step in hand ends on the schedule; None: 1 further on.

    Raises:
        ConfigError: no views.
    """

    until: float | None = None
    chosen: Tensor | None = None

    @torch.no_grad()
    def __init__(
        self,
        model: NerfDiff,
        encoding: Encoding,
        cameras: Cameras,
        views_at_once: int,
        seed: tuple[int | str, ...],
        last: int | None = None,
    ):
        if cameras.shape[1] < 1:
            raise ConfigError("there are no virtual views: set budget.views (or prior.views) to at least 1")
        self.model, self.cameras, self.seed = model, cameras, seed
        self._context = encoding.context
        self.encoding = encoding = model.with_keys_values(encoding)
        self._at_once = views_at_once
        rendered = []
        for part in self._parts(len(self)):
            with timed("guide"):
                rendered.append(model.render(encoding, cameras[:, part]).images)
        self._condition = model.condition(encoding, cameras, torch.cat(rendered, 1))
        self._noise = [generator(encoding.source.device, *seed, view) for view in range(len(self))]
        self._weak: tuple[Autoguidance, Denoiser, Condition] | None = None
        self._last = min(last or len(self), len(self))
        self._order = None if self._last == len(self) else farthest_first(cameras.centres[0])
        self._table: Tensor | None = None
        self.denoiser_calls = 0
        self.field_queries = model.renderer.samples_per_ray * self.first_renderings[:, 0].numel()

    def _parts(self, views: int) -> list[slice]:
        return [slice(i, i + self._at_once) for i in range(0, views, self._at_once)]

    def __len__(self) -> int:
        return self.cameras.shape[1]

    @property
    def first_renderings(self) -> Images:
        """Images of all views by the single-image NeRF, in [0, 1]."""
        return self._condition.rendered

    def choose(self, step: float | int, steps: int) -> None:
        """Choose the views that are denoised and fitted at a place on a schedule of `steps`: `chosen`, None for all.

        Their number falls evenly from all at the first step to `last` at the last. Those that are kept are spread out:
        in turn the one farthest from those kept already. Views that were dropped do not come back. After
        `choose_randomly`, each step has its own.
        """
        if self._table is not None:
            self.chosen = self._table[int(step)]
        elif self._order is not None:
            left = round(len(self) + (self._last - len(self)) * min(1, step / max(1, steps - 1)))
            self.chosen = self._order[:left].sort().values

    def choose_randomly(self, views: int, steps: int) -> None:
        """Let each of so many steps have `views` views of its own, drawn without replacement."""
        if views < len(self):
            draws = generator("cpu", *self.seed, "views of a step")
            table = torch.stack([torch.randperm(len(self), generator=draws)[:views] for _ in range(steps)])
            self._table = table.to(self.encoding.source.device)

    @torch.no_grad()
    def autoguide(self, autoguidance: Autoguidance | None) -> None:
        """Denoise with an earlier snapshot's help from now on, where there is one.

        Raises:
            CheckpointError: it is of another model.
        """
        if autoguidance is None or not autoguidance.on:
            return
        weak = autoguidance.denoiser(self.model)
        context = weak.unet.keys_values(self._context) if weak.cross_attention else []
        self._weak = autoguidance, weak, replace(self._condition, context=context)

    def deep_features(self, deep: DeepReuse | None) -> list[DeepFeatures] | None:
        """Make room for reused features along one reverse process, for `denoise`; None where all is computed.

        Raises:
            ConfigError: views are dropped along it.
        """
        if deep is None or deep.every == 1:
            return None
        if self._order is not None:
            raise ConfigError(
                "strategy.views_last drops views, and with them deep features to reuse: set budget.deep_every=1"
            )
        return [DeepFeatures(deep) for _ in self._parts(len(self))]

    @timed("denoise")
    @torch.no_grad()
    def denoise(
        self,
        z: Images,
        t: Float[Tensor, "views"],
        rendered: Images | None = None,
        deep: Sequence[DeepFeatures] | None = None,
    ) -> Images:
        """Return x0 of every chosen view, clamped to [-1, 1]; zeros for the others.

        Args:
            z: noised images Z_t.
            t: of each view.
            rendered: renderings that condition the CDM, in [0, 1]; None: the first renderings.
            deep: `deep_features`, where calls follow each other along one reverse process; None computes all.
        """
        chosen = slice(None) if self.chosen is None else self.chosen
        given, seen = (z[chosen], t[chosen]), None if rendered is None else rendered[chosen]
        x0 = self._in_parts(self.model.denoiser, self._condition[chosen], *given, seen, deep)
        if self._weak is not None:
            autoguidance, denoiser, condition = self._weak
            x0 = autoguidance(x0, self._in_parts(denoiser, condition[chosen], *given, seen, None))
        x0 = x0.clamp(-1, 1)
        return x0 if self.chosen is None else torch.zeros_like(z).index_copy(0, self.chosen, x0)

    def _in_parts(
        self,
        denoiser: Denoiser,
        condition: Condition,
        z: Images,
        t: Float[Tensor, "views"],
        rendered: Images | None,
        deep: Sequence[DeepFeatures] | None,
    ) -> Images:
        self.denoiser_calls += len(z)
        if rendered is not None:
            condition = replace(condition, rendered=rendered)
        parts = self._parts(len(z))
        deep = [None] * len(parts) if deep is None else deep
        return torch.cat([denoiser(z[p], t[p], condition[p], kept) for p, kept in zip(parts, deep, strict=True)])

    def distance(self, images: Images, others: Images) -> Float[Tensor, ""]:
        """Return the mean squared error of the chosen views' images."""
        chosen = slice(None) if self.chosen is None else self.chosen
        return (images[chosen] - others[chosen]).square().mean()

    def noise(self) -> Images:
        """Draw standard normal images, each from its own view's stream."""
        return torch.stack([self.noise_of(view) for view in range(len(self))])

    def noise_of(self, view: int) -> Float[Tensor, "3 height width"]:
        """Draw a standard normal image from one view's stream."""
        source = self._noise[view]
        return torch.randn(self._condition.rendered.shape[1:], generator=source, device=source.device)

    def uniform(self) -> Float[Tensor, "views"]:
        """Draw a number in [0, 1) for every view, from its own stream."""
        return torch.stack([torch.rand((), generator=g, device=g.device) for g in self._noise])


def farthest_first(points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """Order points so that however many come first, they are spread out: each is the farthest from those before it."""
    apart = (points[:, None] - points).norm(dim=-1).fill_diagonal_(-1)
    nearest, order = apart[0], [torch.zeros(1, dtype=torch.long, device=points.device)]
    for _ in range(len(points) - 1):
        order.append(nearest.argmax()[None])
        nearest = torch.minimum(nearest, apart.index_select(0, order[-1])[0])
    return torch.cat(order)
