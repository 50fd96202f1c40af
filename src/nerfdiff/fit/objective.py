"""The loss of the inner steps: of rays against the colours they should have, and regularisers."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Rays
from nerfdiff.field.field import Field, TriplaneField
from nerfdiff.fit.perceptual import LEAST, STAlex
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import compositing_weights, edges_between, in_bins, uniform_edges
from nerfdiff.utils.errors import ConfigError

LOSSES = ("mse", "l1")
ENTROPY_SHARE = 8
"""One ray of so many has its entropy computed, which queries the field anew."""


@dataclass(frozen=True)
class Objective:
    """Settings of the loss of an inner step; `conf/common/distillation.yaml` has them. The defaults are the paper's.

    Args:
        patch: side in pixels of the square patches that rays are drawn in; 1 is scattered rays.
        loss: of colours: `mse` or `l1`.
        perceptual_weight: of ST-LPIPS on AlexNet over patches (`STAlex`).
        entropy_weight: of `ray_entropy`.

    Raises:
        ConfigError: another loss, a negative weight, no patch, or a perceptual loss of patches too small for it.
    """

    patch: int = 1
    loss: str = "mse"
    perceptual_weight: float = 0.0
    entropy_weight: float = 0.0

    def __post_init__(self):
        if self.loss not in LOSSES:
            raise ConfigError(f"strategy.loss={self.loss!r}: choose {' or '.join(LOSSES)}")
        if self.patch < 1:
            raise ConfigError(f"strategy.patch={self.patch} must be at least 1, which is scattered rays")
        for name in ("perceptual_weight", "entropy_weight"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"strategy.{name}={getattr(self, name)} must be at least 0")
        if self.perceptual_weight > 0 and self.patch < 8:
            raise ConfigError(
                f"strategy.perceptual_weight={self.perceptual_weight} looks at patches: strategy.patch={self.patch} "
                f"is too small to see anything: set it to 8 or more (those below {LEAST} are enlarged to that)"
            )

    def patches_of(self, rays: int) -> int:
        """Return the number of patches that so many rays are.

        Raises:
            ConfigError: they are no whole number of patches.
        """
        patches, left = divmod(rays, self.patch**2)
        if left:
            fewer, more = patches * self.patch**2, (patches + 1) * self.patch**2
            raise ConfigError(
                f"budget.rays={rays} are no whole number of patches of {self.patch} x {self.patch}: set budget.rays to "
                f"{f'{fewer} or ' if fewer else ''}{more}, or another strategy.patch"
            )
        return patches


class FitLoss:
    """The loss of an inner step, with the networks it needs. No `nn.Module`: they are no part of what is fitted.

    Args:
        objective: its settings.
        device: of the field.
    """

    def __init__(self, objective: Objective | None = None, device: torch.device | str = "cpu"):
        self.objective = objective or Objective()
        self._perceptual = STAlex(device) if self.objective.perceptual_weight > 0 else None

    def __call__(
        self,
        rgb: Float[Tensor, "scenes n 3"],
        colours: Float[Tensor, "scenes n 3"],
        weights: Float[Tensor, "scenes n"] | None = None,
    ) -> tuple[Float[Tensor, "scenes"], Float[Tensor, "scenes"]]:
        """Compare rendered colours with those they should be, patch by patch where there are patches.

        Args:
            weights: of the rays; None weighs all the same.

        Returns:
            each scene's loss, and its plain mean squared error, which is comparable among losses.
        """
        settings = self.objective
        squared = F.mse_loss(rgb, colours, reduction="none")
        errors = squared.mean((1, 2))
        if settings.loss == "mse" and weights is None:
            losses = errors
        else:
            each = (squared if settings.loss == "mse" else (rgb - colours).abs()).mean(-1)
            losses = (each if weights is None else weights * each).mean(1)
        if self._perceptual is not None:
            distances = self._perceptual(*(self._as_patches(values) for values in (rgb, colours)))
            distances = distances.reshape(len(rgb), -1)
            if weights is not None:
                distances = distances * weights.reshape(*distances.shape, -1).mean(-1)
            losses = losses + settings.perceptual_weight * distances.mean(1)
        return losses, errors.detach()

    def regularise(
        self,
        losses: Float[Tensor, "scenes"],
        field: TriplaneField,
        renderer: Renderer,
        rays: Rays,
        jitter: Float[Tensor, "scenes n samples"],
    ) -> Float[Tensor, "scenes"]:
        """Add the regularisers to each scene's loss."""
        settings = self.objective
        if settings.entropy_weight > 0:
            some = Rays(*(values[:, ::ENTROPY_SHARE] for values in vars(rays).values()))
            uniform = jitter[:, ::ENTROPY_SHARE, : renderer.uniform_samples]
            losses = losses + settings.entropy_weight * ray_entropy(field, some, uniform).mean(1)
        return losses

    def queries(self, rays: int, renderer: Renderer) -> int:
        """Return the number of points of one scene at which regularisers evaluate the field."""
        some = len(range(0, rays, ENTROPY_SHARE)) if self.objective.entropy_weight > 0 else 0
        return some * renderer.uniform_samples

    def _as_patches(self, values: Float[Tensor, "scenes n 3"]) -> Float[Tensor, "patches 3 side side"]:
        side = self.objective.patch
        return values.reshape(-1, side, side, 3).movedim(-1, 1)


def ray_entropy(field: Field, rays: Rays, jitter: Float[Tensor, "scenes n samples"]) -> Float[Tensor, "scenes n"]:
    """Return how spread out along each ray is what it sees: the entropy of the weights of its samples and of what is
    behind them all, over its largest value (MVEdit's ray entropy, arXiv 2403.12032, over equal bins).

    Args:
        jitter: in [0, 1), of one sample per bin.
    """
    edges = uniform_edges(rays.near, rays.far, jitter.shape[-1])
    distances = in_bins(edges, jitter)
    directions = rays.directions[..., None, :].expand(*distances.shape, 3)
    _, density = field(rays.at(distances).flatten(1, 2), directions.flatten(1, 2))
    lengths = edges_between(distances, rays.near, rays.far).diff(dim=-1)
    weights = compositing_weights(density.reshape(distances.shape), lengths)
    behind = (1 - weights.sum(-1, keepdim=True)).clamp_min(0)
    shares = torch.cat([weights, behind], -1)
    return -torch.xlogy(shares, shares.clamp_min(1e-8)).sum(-1) / math.log(shares.shape[-1])
