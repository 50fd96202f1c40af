"""Render a world with Mitsuba 3. Mitsuba is imported on first use: geometry and layouts do not need it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nerfdiff.utils.errors import ConfigError
from procedural.colour import linear_to_srgb8


@dataclass(frozen=True)
class Film:
    """Settings of rendered images.

    Args:
        height, width: pixels.
        fov: angle of view across the width, in degrees.
        samples_per_pixel: for colour; depth and labels take the one ray through the pixel's centre.
        max_depth: longest light path; 2 is direct light, 3 adds one bounce between surfaces.
        passes: into how many renderings the samples are shared. With several, a pass far brighter than their
            median is toned down: light focused by metal is found too rarely to average out.
    """

    height: int
    width: int
    fov: float
    samples_per_pixel: int
    max_depth: int = 3
    passes: int = 1


@runtime_checkable
class World(Protocol):
    """A scene to render."""

    def entries(self, mi: Any) -> dict[str, Any]:
        """Lights and shapes of a Mitsuba scene, by name."""

    def labels(self, points: Float[np.ndarray, "*image 3"]) -> Int[np.ndarray, "*image"]:
        """Return the object at each surface point: 0 is background, objects count from 1."""


@dataclass(frozen=True)
class Views:
    """Rendered views of one world.

    Args:
        radiance: linear colour, multiplied by `alpha`.
        alpha: how much of the pixel is covered by shapes.
        depth: distance along the camera's z axis where the ray through a pixel's centre hits, else 0.
        mask: whether that ray hits.
        labels: what that ray hits, as `World.labels`; 0 where it hits nothing.
    """

    radiance: Float[np.ndarray, "views height width 3"]
    alpha: Float[np.ndarray, "views height width"]
    depth: Float[np.ndarray, "views height width"]
    mask: Bool[np.ndarray, "views height width"]
    labels: Int[np.ndarray, "views height width"]

    @cached_property
    def rgb(self) -> UInt8[np.ndarray, "views height width 3"]:
        """Colours on white."""
        return linear_to_srgb8(self.radiance + (1 - self.alpha[..., None]))


def resolve_variant(variant: str) -> str:
    """`auto` becomes `cuda_ad_rgb` where Mitsuba finds a CUDA device, else `scalar_rgb`.

    Raises:
        ConfigError: this Mitsuba has no such variant, or there is no Mitsuba.
    """
    try:
        import drjit
        import mitsuba
    except ModuleNotFoundError as error:
        raise ConfigError("rendering scenes needs Mitsuba: pip install mitsuba") from error

    if variant == "auto":
        return "cuda_ad_rgb" if drjit.has_backend(drjit.JitBackend.CUDA) else "scalar_rgb"
    if variant not in mitsuba.variants():
        raise ConfigError(f"variant={variant}: expected auto or one of {', '.join(mitsuba.variants())}")
    return variant


def robust_mean(passes: Sequence[Float[np.ndarray, "height width 4"]]) -> Float[np.ndarray, "height width 4"]:
    """The mean of renderings of one image, colours being limited to 1.5 times their median over the passes."""
    if len(passes) == 1:
        return passes[0]
    stack = np.stack(passes)
    limit = 1.5 * np.median(stack, axis=0) + 0.02
    limit[..., 3] = np.inf
    return np.minimum(stack, limit).mean(axis=0)


class MitsubaRenderer:
    """Renders on one thread: many processes share the work, and results do not depend on their number.

    Args:
        variant: a Mitsuba variant, not `auto`.
        film: how images are taken.
    """

    def __init__(self, variant: str, film: Film):
        import drjit
        import mitsuba

        if mitsuba.variant() != variant:
            mitsuba.set_variant(variant)
        # The sampler would say at every view that it rounds the number of samples up.
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        drjit.set_thread_count(1)
        self.mi = mitsuba
        self.film = film
        # hide_emitters leaves the background transparent.
        self.colour = mitsuba.load_dict({"type": "path", "max_depth": film.max_depth, "hide_emitters": True})
        self.first_hit = mitsuba.load_dict({"type": "aov", "aovs": "p:position,n:geo_normal"})

    def render(self, world: World, c2w: Float[np.ndarray, "views 4 4"], seed: int) -> Views:
        """Render `world` from every pose; `seed` fixes the noise."""
        scene = self.mi.load_dict({"type": "scene", **world.entries(self.mi)}, parallel=False)
        views = (self._view(scene, pose, seed + 7919 * k) for k, pose in enumerate(c2w))
        radiance, alpha, depth, mask, position = (np.stack(values) for values in zip(*views, strict=True))
        return Views(radiance, alpha, depth, mask, np.where(mask, world.labels(position), 0))

    def _view(self, scene, pose, seed):
        mi, samples = self.mi, self.film.samples_per_pixel // self.film.passes
        sensor = self._sensor(pose, {"type": "multijitter", "sample_count": samples})
        seeds = [(seed + 104729 * k) % 2**32 for k in range(self.film.passes)]
        image = robust_mean(
            [np.array(mi.render(scene, sensor=sensor, integrator=self.colour, seed=s, spp=samples)) for s in seeds]
        )
        alpha = np.clip(image[..., 3], 0, 1)

        # One stratum without jitter is the pixel's centre, and a box filter keeps pixels apart.
        centre = self._sensor(pose, {"type": "stratified", "sample_count": 1, "jitter": False})
        hit = np.array(mi.render(scene, sensor=centre, integrator=self.first_hit, seed=0, spp=1))
        position, normal = hit[..., -6:-3], hit[..., -3:]
        mask = (normal**2).sum(-1) > 0.5
        depth = np.where(mask, (position.astype(np.float64) - pose[:3, 3]) @ pose[:3, 2], 0.0)
        return np.clip(image[..., :3], 0, None), alpha, depth, mask, position

    def _sensor(self, pose, sampler):
        mi, film = self.mi, self.film
        centre, forward, up = pose[:3, 3], pose[:3, 2], -pose[:3, 1]
        return mi.load_dict(
            {
                "type": "perspective",
                "fov": film.fov,
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 100.0,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=centre.tolist(), target=(centre + forward).tolist(), up=up.tolist()
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": film.width,
                    "height": film.height,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": sampler,
            }
        )
