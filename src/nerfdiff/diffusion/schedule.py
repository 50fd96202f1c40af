"""The cosine noise schedule and the algebra among its parametrisations, as pure functions.

Notation (paper, "Training phase"; Salimans & Ho 2022): Z_t = α_t x0 + σ_t ε, α_t = cos(πt/2),
σ_t = sin(πt/2), t in [0, 1], v = α_t ε − σ_t x0. Every function broadcasts over its arguments.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def alpha_sigma(t: Float[Tensor, "*shape"]) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """(α_t, σ_t), exact at both ends.

    α_t is computed as sin(π(1 − t)/2): fp32 cos(π/2) is −4.4e-8, and 1 − t is exact for t >= 1/2, so α keeps
    its relative precision where the SNR needs it.
    """
    return torch.sin(0.5 * math.pi * (1 - t)), torch.sin(0.5 * math.pi * t)


def snr(t: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Signal-to-noise ratio α_t² / σ_t²; infinite at t = 0."""
    alpha, sigma = alpha_sigma(t)
    return (alpha / sigma) ** 2


def add_noise(
    x0: Float[Tensor, "*shape"],
    eps: Float[Tensor, "*shape"],
    alpha: Float[Tensor, "*#shape"],
    sigma: Float[Tensor, "*#shape"],
) -> Float[Tensor, "*shape"]:
    """Z_t = α_t x0 + σ_t ε."""
    return alpha * x0 + sigma * eps


def v_from_x0_eps(x0: Tensor, eps: Tensor, alpha: Tensor, sigma: Tensor) -> Tensor:
    """v = α ε − σ x0."""
    return alpha * eps - sigma * x0


def x0_from_v(z: Tensor, v: Tensor, alpha: Tensor, sigma: Tensor) -> Tensor:
    """x0 = α Z − σ v: no division, so it holds at both ends."""
    return alpha * z - sigma * v


def eps_from_x0(z: Tensor, x0: Tensor, alpha: Tensor, sigma: Tensor) -> Tensor:
    """ε = (Z − α x0) / σ; undefined at t = 0, where Z holds no noise."""
    return (z - alpha * x0) / sigma


def expand(coefficient: Float[Tensor, "batch"], like: Float[Tensor, "batch ..."]) -> Tensor:
    """A per-sample coefficient, shaped to broadcast against `like`."""
    return coefficient.reshape(-1, *[1] * (like.ndim - 1))
