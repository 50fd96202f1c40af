"""Counter-based randomness: every random number is a function of the seed and of what it is for.

Nothing depends on how many numbers were drawn before, so a resumed run, a run on other hardware counts or with
other worker counts sees the same noise.
"""

import hashlib

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def seed_of(*parts: int | str) -> int:
    """A 63-bit seed from any sequence of numbers and names."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def generator(device: torch.device | str, *parts: int | str) -> torch.Generator:
    """A fresh generator on `device` seeded by `seed_of(*parts)`."""
    return torch.Generator(device).manual_seed(seed_of(*parts))


def spread_times(draws: Int64[Tensor, "batch"], seed: int) -> Float[Tensor, "batch"]:
    """One diffusion time in [0, 1) per draw: a golden-ratio sequence, so that any run of consecutive draws covers
    the interval evenly (the low-variance sampling of Kingma et al. 2021, without a batch to stratify over)."""
    offset = seed_of(seed, "times") / 2**63
    # The golden ratio as a 32-bit fixed-point fraction: exact integer arithmetic, whatever the draw number.
    step = 2654435769
    fraction = (draws % 2**32 * step) % 2**32
    return ((fraction.double() / 2**32 + offset) % 1.0).float()
