"""The reference volume renderer: plain PyTorch, bounded memory."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field import cpu_field
from nerfdiff.field.field import FieldFn
from nerfdiff.render.backend import check_choice, fused
from nerfdiff.render.compositing import compositing_weights
from nerfdiff.render.sampling import edges_between, importance_distances, in_bins, uniform_edges

CACHED_POINTS = 2**16
"""Points at once on a CPU, whatever `chunk` allows: more leave its caches, fewer cost more calls (measured)."""


@dataclass(frozen=True)
class Rendering:
    """What rays saw. `*rays` is the leading shape of the rays.

    Args:
        rgb: colour over the background.
        opacity: accumulated weight in [0, 1].
        depth: expected distance along the ray given that something was hit; `far` where nothing was.
    """

    rgb: Float[Tensor, "*rays 3"]
    opacity: Float[Tensor, "*rays"]
    depth: Float[Tensor, "*rays"]


@dataclass(frozen=True)
class Renderer:
    """Uniform, then importance samples of one and the same field, composited together.

    Args:
        uniform_samples, importance_samples: per ray; the paper uses 64 and 64.
        background: grey level behind everything (1 is white); None where a scene has no empty background: the
            farthest sample of each ray is then opaque.
        chunk: points whose intermediate values memory holds. Rendering takes them at most at once; under autograd, rays
            with more points are recomputed chunk by chunk in the backward pass, so what is kept, beside the rays
            themselves, is O(chunk) whatever the number of samples.
        backend: `torch` is this reference; `triton` renders triplane fields by fused kernels; `auto` takes these on a
            GPU, and on a CPU the field in the form that it computes fastest. Where kernels cannot run, the reference
            does, and a log line says why.
        precision: of the kernels' products, whose sums are fp32: `ieee` (slow), `tf32x3` (nearly fp32), `tf32`, `bf16`,
            or `auto` for what the reference's products are computed in.

    Raises:
        ConfigError: another `backend` or `precision`.
    """

    uniform_samples: int
    importance_samples: int
    background: float | None
    chunk: int
    backend: str = "auto"
    precision: str = "auto"

    def __post_init__(self):
        check_choice(self.backend, self.precision)

    @property
    def samples_per_ray(self) -> int:
        return self.uniform_samples + self.importance_samples

    def render(self, field: FieldFn, rays: Rays, jitter: Float[Tensor, "batch n samples"] | None = None) -> Rendering:
        """Render rays of leading shape [batch, n] through a batch of fields.

        Args:
            jitter: uniform in [0, 1), last axis `samples_per_ray`; None is deterministic.
        """
        values = fused(self, field, rays, jitter)
        if values is not None:
            return Rendering(*values)
        per_ray = rays.near.shape[0] * self.samples_per_ray
        recompute = torch.is_grad_enabled() and rays.near.shape[1] > max(1, self.chunk // per_ray)
        parts = [rays.origins, rays.directions, rays.near, rays.far]
        if jitter is not None:
            parts.append(jitter)
        if self.backend != "auto" or not cpu_field.suits(field, rays):
            return Rendering(*self._in_chunks(field, parts, recompute))
        scenes = zip(cpu_field.scene_by_scene(field), *(part.split(1) for part in parts), strict=True)
        outputs = [self._in_chunks(alone, own, recompute) for alone, *own in scenes]
        return Rendering(*(torch.cat(values) for values in zip(*outputs, strict=True)))

    def render_views(
        self,
        field: FieldFn,
        cameras: Cameras,
        near: Float[Tensor, "batch"],
        far: Float[Tensor, "batch"],
        jitter: Float[Tensor, "batch n samples"] | None = None,
    ) -> Rendering:
        """Render whole images of cameras [batch, views], given in the input cameras' space.

        Returns:
            A rendering of leading shape [batch, views, height, width].
        """
        rays = cameras.rays(near[:, None], far[:, None])
        shape = torch.broadcast_shapes(rays.near.shape, rays.directions.shape[:-1])
        flat = Rays(
            rays.origins.flatten(1, 3),
            rays.directions.flatten(1, 3),
            rays.near.expand(shape).flatten(1, 3),
            rays.far.expand(shape).flatten(1, 3),
        )
        out = self.render(field, flat, jitter)
        return Rendering(out.rgb.reshape(*shape, 3), out.opacity.reshape(shape), out.depth.reshape(shape))

    def _in_chunks(self, field, parts, recompute):
        """The values of a `Rendering`, of rays split along their second axis."""
        points = min(self.chunk, CACHED_POINTS) if parts[0].device.type == "cpu" else self.chunk
        per_chunk = max(1, points // (len(parts[0]) * self.samples_per_ray))
        outputs = []
        for chunk in zip(*(part.split(per_chunk, dim=1) for part in parts), strict=True):
            if recompute:
                # Nothing random happens inside: the jitter is an argument.
                outputs.append(checkpoint(self._render, field, *chunk, use_reentrant=False, preserve_rng_state=False))
            else:
                outputs.append(self._render(field, *chunk))
        return [torch.cat(values, dim=1) for values in zip(*outputs, strict=True)]

    def _render(self, field, origins, directions, near, far, jitter=None):
        rays = Rays(origins, directions, near, far)
        uniform_jitter, importance_jitter = (
            (None, None) if jitter is None else jitter.tensor_split([self.uniform_samples], dim=-1)
        )
        edges = uniform_edges(near, far, self.uniform_samples)
        distances = in_bins(edges, uniform_jitter)
        rgb, density = self._query(field, rays, distances)
        if self.importance_samples > 0:
            with torch.no_grad():
                bins = edges_between(distances, near, far)
                weights = compositing_weights(density, bins.diff(dim=-1))
                drawn = importance_distances(bins, weights, self.importance_samples, importance_jitter)
            rgb_drawn, density_drawn = self._query(field, rays, drawn)
            distances, order = torch.cat([distances, drawn], -1).sort(-1)
            rgb = torch.cat([rgb, rgb_drawn], -2).gather(-2, order[..., None].expand(*order.shape, 3))
            density = torch.cat([density, density_drawn], -1).gather(-1, order)
        lengths = edges_between(distances, near, far).diff(dim=-1)
        weights = compositing_weights(density, lengths)
        if self.background is None:
            weights = torch.cat([weights[..., :-1], 1 - weights[..., :-1].sum(-1, keepdim=True)], -1)
        opacity = weights.sum(-1)
        colour = (weights[..., None] * rgb).sum(-2)
        if self.background is not None:
            colour = colour + (1 - opacity)[..., None] * self.background
        reached = opacity > 1e-6
        expected = (weights * distances).sum(-1) / opacity.clamp_min(1e-6)
        return colour, opacity, torch.where(reached, expected, far)

    @staticmethod
    def _query(field, rays, distances):
        points = rays.at(distances)
        rgb, density = field(points.flatten(1, 2))
        return rgb.reshape(*points.shape), density.reshape(points.shape[:-1])
