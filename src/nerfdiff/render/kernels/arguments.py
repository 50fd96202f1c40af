"""What kernels are told of settings, fields and rays."""

from dataclasses import dataclass

import triton
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Settings:
    """What does not change from ray to ray.

    Args:
        uniform_samples, importance_samples, background: as `Renderer`'s.
        points: samples in memory at once, as distances: rays are taken in chunks of no more.
        ordered_points: the same for a backward pass in a fixed order, which keeps features' gradients as well.
        precision: of the decoder's products: "ieee", "tf32x3", "tf32", "bf16" (which stores planes in bf16 as well),
            or "rounded", bf16's numbers computed in fp32.
        ordered: every sum in a fixed order, the planes' gradients among them.
        image_width, image_height: of the input cameras.
        density_shift, density_scale: the decoder's.
    """

    uniform_samples: int
    importance_samples: int
    background: float | None
    points: int
    ordered_points: int
    precision: str
    ordered: bool
    image_width: int
    image_height: int
    density_shift: float
    density_scale: float

    @property
    def samples(self) -> int:
        """Per ray."""
        return self.uniform_samples + self.importance_samples


@dataclass(frozen=True)
class Fields:
    """Triplane fields as the kernels read them: contiguous.

    Args:
        planes: channels last, fp32 or bf16.
        K: of the input cameras, in pixels.
        near, far: t_n and t_f.
        w1, b1, w2, b2: of the decoder's layers; of a decoder for each scene with `scenes` in front.
    """

    planes: Float[Tensor, "scenes 3 height width channels"]
    K: Float[Tensor, "scenes 3 3"]
    near: Float[Tensor, "scenes"]
    far: Float[Tensor, "scenes"]
    w1: Float[Tensor, "*scenes hidden channels"]
    b1: Float[Tensor, "*scenes hidden"]
    w2: Float[Tensor, "*scenes 4 hidden"]
    b2: Float[Tensor, "*scenes 4"]

    @property
    def shared(self) -> bool:
        """Whether all scenes have one decoder."""
        return self.w1.ndim == 2

    def arguments(self, settings: Settings) -> dict:
        """Of every kernel that evaluates a field."""
        hidden, channels = self.w1.shape[-2:]
        return {
            "planes": self.planes,
            "K": self.K,
            "scene_near": self.near,
            "scene_far": self.far,
            "w1": self.w1,
            "b1": self.b1,
            "w2": self.w2,
            "b2": self.b2,
            "image_width": float(settings.image_width),
            "image_height": float(settings.image_height),
            "shift": float(settings.density_shift),
            "scale": float(settings.density_scale),
            "height": self.planes.shape[2],
            "width": self.planes.shape[3],
            "SHARED": self.shared,
            "PRECISION": settings.precision,
            "C": channels,
            "HIDDEN": hidden,
            # a product's inner side is at least 16 long
            "CP": max(16, triton.next_power_of_2(channels)),
            "HP": max(16, triton.next_power_of_2(hidden)),
        }


@dataclass(frozen=True)
class Bundle:
    """Rays [scenes, n], their jitter and coarse weights as the kernels read them: contiguous, fp32.

    Args:
        coarse: of equal bins along each ray, fp32 or a half; None where they are yet to be found.
    """

    origins: Float[Tensor, "scenes n 3"]
    directions: Float[Tensor, "scenes n 3"]
    near: Float[Tensor, "scenes n"]
    far: Float[Tensor, "scenes n"]
    jitter: Float[Tensor, "scenes n samples"] | None
    coarse: Float[Tensor, "scenes n bins"] | None = None

    def arguments(self) -> dict:
        """Of every kernel that walks along rays."""
        return {
            "origins": self.origins,
            "directions": self.directions,
            "near": self.near,
            "far": self.far,
            "n": self.near.shape[1],
        }

    def chunks(self, points: int, samples: int) -> list[tuple[int, int]]:
        """(first, count) of rays so that no more than so many points are in memory, of one ray at least."""
        scenes, n = self.near.shape
        size = max(1, points // (scenes * samples))
        return [(first, min(size, n - first)) for first in range(0, n, size)]
