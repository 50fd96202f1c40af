"""Quadrature along a ray: uniform bins, importance samples by their weights, and the weights of the integral."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from nerfdiff.utils.precision import at_least_single

KEPT = torch.float16
"""Type of kept coarse weights: there are many of them, and samples are random anyway."""


def compositing_weights(
    density: Float[Tensor, "*rays samples"], lengths: Float[Tensor, "*rays samples"]
) -> Float[Tensor, "*rays samples"]:
    """Return ω_i = T_i (1 − exp(−σ_i δ_i)), T_i = exp(−Σ_{j<i} σ_j δ_j) (paper, eq. "nerf").

    fp32 throughout, with T as the exponential of an exclusive cumulative sum: a bf16 cumulative product of many
    nearly transparent samples stays at 1.
    """
    optical = at_least_single(density) * at_least_single(lengths)
    # shifted: a sum less its last term has lost what came before a much larger one
    before = pad(optical.cumsum(-1)[..., :-1], (1, 0))
    return torch.exp(-before) * -torch.expm1(-optical)


def uniform_edges(near: Float[Tensor, "*rays"], far: Float[Tensor, "*rays"], n: int) -> Float[Tensor, "*rays {n}+1"]:
    """Return the n + 1 edges of n equal bins between near and far."""
    steps = torch.linspace(0, 1, n + 1, dtype=near.dtype, device=near.device)
    return near[..., None] + (far - near)[..., None] * steps


def in_bins(
    edges: Float[Tensor, "*rays edges"], jitter: Float[Tensor, "*rays edges-1"] | None
) -> Float[Tensor, "*rays edges-1"]:
    """Return one distance per bin: its centre, or the place `jitter` in [0, 1) picks (stratified sampling).

    n bins have n + 1 edges.
    """
    offset = 0.5 if jitter is None else jitter
    return edges[..., :-1] + offset * edges.diff(dim=-1)


def importance_distances(
    edges: Float[Tensor, "*rays edges"],
    weights: Float[Tensor, "*rays edges-1"],
    n: int,
    jitter: Float[Tensor, "*rays {n}"] | None,
    floor: float = 1e-2,
) -> Float[Tensor, "*rays {n}"]:
    """Draw n distances by inverse CDF from the piecewise-constant density `weights` over the bins.

    Args:
        edges, weights: one edge more than there are bins, and so weights.
        jitter: in [0, 1), one per drawn distance; None takes the n quantile centres.
        floor: share of the samples spread evenly over all bins, so that an empty ray (all weights zero) is sampled
            evenly and every bin has a chance.

    Returns:
        Ascending distances. No gradient flows through the choice of samples.
    """
    weights = at_least_single(weights.detach())
    total = weights.sum(-1, keepdim=True)
    share = torch.where(total > 1e-8, weights / total.clamp_min(1e-8), 1.0 / weights.shape[-1])
    share = (1 - floor) * share + floor / weights.shape[-1]
    cdf = torch.cat([torch.zeros_like(total), share.cumsum(-1)], -1)
    cdf = cdf / cdf[..., -1:]
    quantile_edges = torch.linspace(0, 1, n + 1, dtype=weights.dtype, device=weights.device)
    u = in_bins(quantile_edges.expand(*weights.shape[:-1], n + 1), jitter).contiguous()
    upper = torch.searchsorted(cdf, u, right=True).clamp(1, weights.shape[-1])
    lower = upper - 1
    c0, c1 = cdf.gather(-1, lower), cdf.gather(-1, upper)
    e0, e1 = edges.gather(-1, lower), edges.gather(-1, upper)
    fraction = ((u - c0) / (c1 - c0).clamp_min(1e-12)).clamp(0, 1)
    return e0 + fraction * (e1 - e0)


def edges_between(
    distances: Float[Tensor, "*rays n"], near: Float[Tensor, "*rays"], far: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays n+1"]:
    """Return the edges of intervals that partition [near, far], one around each of these ascending distances."""
    middle = 0.5 * (distances[..., 1:] + distances[..., :-1])
    return torch.cat([near[..., None], middle, far[..., None]], -1)
