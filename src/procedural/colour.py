"""The sRGB transfer function, both ways."""

import numpy as np
from jaxtyping import Float, UInt, UInt8


def srgb_to_linear(value: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """IEC 61966-2-1, from [0, 1] to [0, 1]."""
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """IEC 61966-2-1, clipped to [0, 1]."""
    value = np.clip(value, 0, 1)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def linear_to_srgb8(value: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """`linear_to_srgb`, rounded to 8 bits."""
    return np.round(linear_to_srgb(value) * 255).astype(np.uint8)


def rgba(
    radiance: Float[np.ndarray, "*image 3"], alpha: Float[np.ndarray, "*image"], bits: int
) -> UInt[np.ndarray, "*image 4"]:
    """sRGB and coverage as 8 or 16 bit integers.

    Args:
        radiance: linear, premultiplied by `alpha`; the result is not, as PNG wants it.
    """
    covered = alpha[..., None] > 0
    straight = np.divide(radiance, alpha[..., None], out=np.zeros_like(radiance), where=covered)
    values = np.concatenate([linear_to_srgb(straight), alpha[..., None]], axis=-1)
    return np.round(values * (2**bits - 1)).astype({8: np.uint8, 16: np.uint16}[bits])
