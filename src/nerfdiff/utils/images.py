"""Colours in [0, 1], as files and renderings have them, and in [-1, 1], as networks and diffusion do."""

from jaxtyping import Float
from torch import Tensor


def to_signed(images: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Map [0, 1] to [-1, 1]."""
    return 2 * images - 1


def to_unit(images: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Map [-1, 1] to [0, 1]."""
    return 0.5 * (images + 1)
