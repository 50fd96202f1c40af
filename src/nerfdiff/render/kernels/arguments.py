"""Arguments of kernels: settings, fields and rays."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Settings:
    """Settings that do not change from ray to ray.

    Args:
        uniform_samples, importance_samples, background, least_transmittance: as `Renderer`'s.
        points: samples in memory at once: rays are taken in chunks of no more.
        ordered_points: the same for a backward pass in a fixed order, which keeps features' gradients as well.
        half: texels, their interpolation and the activation in fp16; sums over hidden units and along rays are fp32.
        ordered: every sum in a fixed order, the planes' gradients among them.
        image_width, image_height: of the input cameras.
        density_shift, density_scale: the decoder's.
    """

    uniform_samples: int
    importance_samples: int
    background: float | None
    points: int
    ordered_points: int
    half: bool
    ordered: bool
    image_width: int
    image_height: int
    density_shift: float
    density_scale: float
    least_transmittance: float = 0.0

    @property
    def samples(self) -> int:
        """Per ray."""
        return self.uniform_samples + self.importance_samples


@dataclass(frozen=True)
class Fields:
    """Triplane fields as the kernels read them: contiguous.

    Args:
        table: texels after the decoder's hidden layer, before its activation (see `texels`): fp16 or fp32.
        K: of the input cameras, in pixels.
        near, far: t_n and t_f.
        w2, b2: of the decoder's output layer; of a decoder for each scene with `scenes` in front.
    """

    table: Float[Tensor, "scenes 3 height width padded"]
    K: Float[Tensor, "scenes 3 3"]
    near: Float[Tensor, "scenes"]
    far: Float[Tensor, "scenes"]
    w2: Float[Tensor, "*scenes 4 hidden"]
    b2: Float[Tensor, "*scenes 4"]

    def arguments(self, settings: Settings) -> dict:
        """Return the arguments of every kernel that evaluates a field."""
        return {
            "table": self.table,
            "K": self.K,
            "scene_near": self.near,
            "scene_far": self.far,
            "w2": self.w2,
            "b2": self.b2,
            "image_width": float(settings.image_width),
            "image_height": float(settings.image_height),
            "SHARED": self.w2.ndim == 2,
            "HALF": settings.half,
            "HIDDEN": self.w2.shape[-1],
            "HP": self.table.shape[-1],
            "H": self.table.shape[2],
            "W": self.table.shape[3],
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

    def chunks(self, points: int, samples: int) -> list[tuple[int, int]]:
        """(first, count) of rays so that no more than so many points are in memory, of one ray at least."""
        scenes, n = self.near.shape
        size = max(1, points // (scenes * samples))
        return [(first, min(size, n - first)) for first in range(0, n, size)]


@dataclass(frozen=True)
class Seen:
    """Samples along some rays.

    Args:
        distances: of the uniform samples, then of those drawn: both ascending.
        values: red, green, blue, and density per scene unit at them.
        stops: of each ray, the distance behind which it was not followed; None where it was to its end.
        sums: of the uniform samples' weights, from the first on.
    """

    distances: Float[Tensor, "scenes count samples"]
    values: Float[Tensor, "scenes count samples 4"]
    stops: Float[Tensor, "scenes count"] | None
    sums: Float[Tensor, "scenes count uniform"]
