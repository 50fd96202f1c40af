"""The reference volume renderer: plain PyTorch, bounded memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field import cpu_field
from nerfdiff.field.field import Field
from nerfdiff.render.backend import check_choice, fused
from nerfdiff.render.sampling import (
    KEPT,
    compositing_weights,
    edges_between,
    importance_distances,
    in_bins,
    uniform_edges,
)
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.precision import full_precision

CACHED_POINTS = 2**16
"""Points at once on a CPU, whatever `chunk` allows: more leave its caches, fewer cost more calls (measured)."""

PARTS = ("origins", "directions", "near", "far", "jitter", "coarse")
"""Arguments with one entry per ray."""


@dataclass(frozen=True)
class Rendering:
    """Rendered rays. `*rays` is their leading shape.

    Args:
        rgb: colour over the background.
        opacity: accumulated weight in [0, 1].
        depth: expected distance along the ray given a hit, in scene units; `far` where there is none.
        coarse: weights of the uniform samples, each in the middle of one of so many equal bins, from which the others
            were drawn; in half precision, and only where they are to be kept.
    """

    rgb: Float[Tensor, "*rays 3"]
    opacity: Float[Tensor, "*rays"]
    depth: Float[Tensor, "*rays"]
    coarse: Float[Tensor, "*rays bins"] | None = None


@dataclass(frozen=True)
class RenderedViews:
    """Whole images; `opacity`, `depth` and `coarse` are those of a `Rendering`.

    Args:
        images: colour over the background, in [0, 1].
    """

    images: Float[Tensor, "batch views 3 height width"]
    opacity: Float[Tensor, "batch views height width"]
    depth: Float[Tensor, "batch views height width"]
    coarse: Float[Tensor, "batch views height width bins"] | None = None


@dataclass(frozen=True)
class Renderer:
    """Render a field by uniform, then importance samples of it, composited together (NeRF, arXiv 2003.08934).

    Unlike NeRF's, both kinds are samples of the same field.

    Args:
        uniform_samples, importance_samples: per ray; the paper uses 64 and 64.
        background: grey level behind everything (1 is white); None where a scene has no empty background: the
            farthest sample of each ray is then opaque.
        chunk: points whose intermediate values memory holds. Rendering takes them at most at once; under autograd, rays
            with more points are recomputed chunk by chunk in the backward pass, so what is kept, beside what is given
            of the rays, is O(chunk) whatever the number of samples.
        backend: `torch` is this reference; `triton` renders triplane fields by fused kernels; `auto` takes these on a
            GPU, and on a CPU the field in the form that it computes fastest. Where kernels cannot run, the reference
            does, and a log line says why.
        kernel_precision: of the kernels' texels and activations: `bf16` for halves (they are fp16, and colours within
            0.002 of the reference's), `ieee`, `tf32x3` or `tf32` for fp32, or `auto` for halves under autocast alone.
        least_transmittance: kernels follow a ray no further than to where uniform samples let less of the light pass.
            Colours and opacities lack about as much, gradients up to fifty times as much of their length (measured);
            0 follows rays to their ends, as the reference does.
        skip: what a CPU leaves out of the backward pass of a triplane: `none`, or `faint`: samples whose gradients
            together are less than a thousandth of all (`field.cpu_field.Faint`). Renderings are the same, bit for bit.
            A distillation with `faint` also leaves empty pixels of its own renderings as they were.

    Raises:
        ConfigError: another `backend`, `kernel_precision` or `skip`, or a `least_transmittance` outside [0, 1).
    """

    uniform_samples: int
    importance_samples: int
    background: float | None
    chunk: int
    backend: str = "auto"
    kernel_precision: str = "auto"
    least_transmittance: float = 0.0
    skip: str = "none"

    def __post_init__(self):
        check_choice(self.backend, self.kernel_precision, self.skip)
        if not 0 <= self.least_transmittance < 1:
            raise ConfigError(
                f"least_transmittance={self.least_transmittance}: expected 0 (exact) or more, less than 1"
            )

    @property
    def samples_per_ray(self) -> int:
        return self.uniform_samples + self.importance_samples

    def render(
        self,
        field: Field,
        rays: Rays,
        jitter: Float[Tensor, "batch n samples"] | None = None,
        coarse: Float[Tensor, "batch n bins"] | None = None,
        keep_coarse: bool = False,
    ) -> Rendering:
        """Render rays of leading shape [batch, n] through a batch of fields.

        Args:
            jitter: uniform in [0, 1), last axis `samples_per_ray`; None is deterministic.
            coarse: `Rendering.coarse` of an earlier rendering of these rays: importance samples are drawn from it
                instead of from what the uniform samples see now, so that all samples can be looked at together.
                There are as many of both kinds as without it. No gradient flows into it.
            keep_coarse: give the rendering its `coarse`, where importance samples are drawn. Samples that are to
                stand for equal bins take no jitter.

        Raises:
            ValueError: `coarse` of another shape than [batch, n, uniform_samples], or `keep_coarse` with `coarse` or
                jitter.
        """
        self._check_coarse(rays, jitter, coarse, keep_coarse)
        values = fused(self, field, rays, jitter, coarse, keep_coarse)
        if values is not None:
            return Rendering(*values)
        per_ray = rays.near.shape[0] * self.samples_per_ray
        recompute = torch.is_grad_enabled() and rays.near.shape[1] > max(1, self.chunk // per_ray)
        parts = vars(rays) | {"jitter": jitter, "coarse": coarse}
        parts = {name: part for name, part in parts.items() if part is not None}
        if self.backend != "auto" or not cpu_field.suits(field, rays):
            return Rendering(*self._in_chunks(field, parts, keep_coarse, recompute))
        outputs = [
            self._in_chunks(alone, own, keep_coarse, recompute)
            for alone, own in zip(
                cpu_field.scene_by_scene(field, cpu_field.SKIP[self.skip]), _split(parts, 1, 0), strict=True
            )
        ]
        return Rendering(*_joined(outputs, axis=0))

    def render_views(
        self,
        field: Field,
        cameras: Cameras,
        near: Float[Tensor, "batch"],
        far: Float[Tensor, "batch"],
        jitter: Float[Tensor, "batch n samples"] | None = None,
        keep_coarse: bool = False,
    ) -> RenderedViews:
        """Render whole images of cameras [batch, views], given in the input cameras' space.

        Args:
            jitter, keep_coarse: as `render`'s.
        """
        rays = cameras.rays(near[:, None], far[:, None])
        shape = torch.broadcast_shapes(rays.near.shape, rays.directions.shape[:-1])
        flat = Rays(
            rays.origins.flatten(1, 3),
            rays.directions.flatten(1, 3),
            rays.near.expand(shape).flatten(1, 3),
            rays.far.expand(shape).flatten(1, 3),
        )
        out = self.render(field, flat, jitter, keep_coarse=keep_coarse)
        coarse = None if out.coarse is None else out.coarse.reshape(*shape, -1)
        images = out.rgb.reshape(*shape, 3).movedim(-1, 2)
        return RenderedViews(images, out.opacity.reshape(shape), out.depth.reshape(shape), coarse)

    def _check_coarse(self, rays, jitter, coarse, keep_coarse):
        if keep_coarse and (coarse is not None or jitter is not None):
            raise ValueError("coarse weights are kept of what uniform samples see, which are not jittered")
        expected = (*rays.near.shape, self.uniform_samples)
        if coarse is not None and coarse.shape != expected:
            raise ValueError(f"coarse weights of shape {tuple(coarse.shape)}, expected {expected}")

    def _in_chunks(self, field, parts, keep_coarse, recompute):
        """Render rays split along their second axis; return the values of a `Rendering`."""
        near = parts["near"]
        points = min(self.chunk, CACHED_POINTS) if near.device.type == "cpu" else self.chunk
        per_chunk = max(1, points // (len(near) * self.samples_per_ray))
        outputs = []
        for chunk in _split(parts, per_chunk, 1):
            given = (field, keep_coarse, *(chunk.get(name) for name in PARTS))
            if recompute:
                # Nothing random happens inside: the jitter is an argument.
                outputs.append(checkpoint(self._render, *given, use_reentrant=False, preserve_rng_state=False))
            else:
                outputs.append(self._render(*given))
        return _joined(outputs, axis=1)

    def _render(self, field, keep_coarse, origins, directions, near, far, jitter, coarse):
        rays = Rays(origins, directions, near, far)
        uniform_jitter, importance_jitter = (
            (None, None) if jitter is None else jitter.tensor_split([self.uniform_samples], dim=-1)
        )
        edges = uniform_edges(near, far, self.uniform_samples)
        distances = in_bins(edges, uniform_jitter)
        kept = ()
        if self.importance_samples == 0:
            rgb, density = self._query(field, rays, distances)
        elif coarse is not None:
            with torch.no_grad():
                drawn = importance_distances(edges, coarse, self.importance_samples, importance_jitter)
            distances = torch.cat([distances, drawn], -1).sort(-1).values
            rgb, density = self._query(field, rays, distances)
        else:
            rgb, density = self._query(field, rays, distances)
            with torch.no_grad():
                bins = edges_between(distances, near, far)
                weights = compositing_weights(density, bins.diff(dim=-1))
                drawn = importance_distances(bins, weights, self.importance_samples, importance_jitter)
                kept = (weights.to(KEPT),) if keep_coarse else ()
            rgb_drawn, density_drawn = self._query(field, rays, drawn)
            distances, order = torch.cat([distances, drawn], -1).sort(-1)
            rgb = torch.cat([rgb, rgb_drawn], -2).gather(-2, order[..., None].expand(*order.shape, 3))
            density = torch.cat([density, density_drawn], -1).gather(-1, order)
        return *self._composite(rays, distances, rgb, density), *kept

    def _composite(self, rays, distances, rgb, density):
        """Integrate along rays: colour, opacity and depth."""
        lengths = edges_between(distances, rays.near, rays.far).diff(dim=-1)
        weights = compositing_weights(density, lengths)
        if self.background is None:
            weights = torch.cat([weights[..., :-1], 1 - weights[..., :-1].sum(-1, keepdim=True)], -1)
        opacity = weights.sum(-1)
        colour = (weights[..., None] * rgb).sum(-2)
        if self.background is not None:
            colour = colour + (1 - opacity)[..., None] * self.background
        reached = opacity > 1e-6
        expected = (weights * distances).sum(-1) / opacity.clamp_min(1e-6)
        return colour, opacity, torch.where(reached, expected, rays.far)

    @staticmethod
    def _query(field, rays, distances):
        points = rays.at(distances)
        directions = rays.directions[..., None, :].expand(points.shape)
        rgb, density = field(points.flatten(1, 2), directions.flatten(1, 2))
        return rgb.reshape(*points.shape), density.reshape(points.shape[:-1])


def _split(parts: dict[str, Tensor], size: int, axis: int) -> Iterator[dict[str, Tensor]]:
    """Split all parts along an axis, so many entries at a time."""
    for values in zip(*(part.split(size, axis) for part in parts.values()), strict=True):
        yield dict(zip(parts, values, strict=True))


def _joined(outputs: Sequence[Sequence[Tensor]], axis: int) -> list[Tensor]:
    """Join the values of parts of the rays."""
    with full_precision(outputs[0][0].device):  # autocast on a CPU cannot join halves
        return [torch.cat(values, axis) for values in zip(*outputs, strict=True)]
