"""The passes over rays: where to look, the picture, and its gradients. Tensors in, tensors out."""

from dataclasses import dataclass

import torch
import triton
from jaxtyping import Float
from torch import Tensor

from nerfdiff.render.kernels.arguments import Bundle, Fields, Settings
from nerfdiff.render.kernels.cells import add_cells
from nerfdiff.render.kernels.coarse import coarse_kernel
from nerfdiff.render.kernels.composite import composite_kernel
from nerfdiff.render.kernels.gradient import gradient_kernel
from nerfdiff.render.kernels.merge import merge_kernel
from nerfdiff.render.kernels.tuning import Launch, programs_per_scene, size_class
from nerfdiff.render.sampling import KEPT, in_bins, uniform_edges

_coarse = Launch(coarse_kernel, [(4, 16, 4), (8, 8, 4), (8, 16, 8), (2, 32, 4)], (4, 8))
_composite = Launch(composite_kernel, [(4, 16, 4), (8, 8, 4), (8, 16, 8), (2, 32, 4)], (4, 8))
# At model B's sizes registers spill least where a thread has few points; (4, 16, 8) spills, and has fewer tiles.
_gradient = Launch(
    gradient_kernel, [(2, 16, 8), (1, 32, 4), (1, 16, 4), (4, 16, 8)], (4, 8), added_to=["d_planes", "d_decoder"]
)


def coarse_weights(
    settings: Settings, fields: Fields, bundle: Bundle, first: int, count: int
) -> Float[Tensor, "scenes {count} bins"]:
    """Weights ω of the uniform samples of rays first … first + count of each scene."""
    scenes = len(fields.planes)
    weights = torch.empty(scenes, count, settings.uniform_samples, device=fields.planes.device)
    _coarse(
        lambda constants: (triton.cdiv(count, constants["R"]), scenes),
        settings.ordered,
        **fields.arguments(settings),
        **bundle.arguments(),
        **_jitter(bundle),
        weights=weights,
        **_part(scenes, first, count, settings.uniform_samples),
    )
    return weights


def merged_distances(
    settings: Settings,
    bundle: Bundle,
    weights: Float[Tensor, "scenes count bins"],
    first: int,
    even: bool = False,
    floor: float = 1e-2,
) -> Float[Tensor, "scenes count samples"]:
    """Uniform and importance samples of rays first … first + count of each scene, in ascending order.

    Args:
        even: whether the weights are of equal bins, rather than of intervals around this bundle's uniform samples.
        floor: as of `importance_distances`.
    """
    scenes, count, bins = weights.shape
    drawn = settings.importance_samples
    distances = torch.empty(scenes, count, bins + drawn, device=weights.device)
    padded = triton.next_power_of_2(drawn)
    rays = max(1, 1024 // padded)
    merge_kernel[(triton.cdiv(count, rays), scenes)](
        weights=weights,
        near=bundle.near,
        far=bundle.far,
        **_jitter(bundle),
        distances=distances,
        n=bundle.near.shape[1],
        first=first,
        count=count,
        samples=bins,
        drawn=drawn,
        floor=floor,
        EVEN=even,
        DP=padded,
        R=rays,
    )
    return distances


def distances_along(
    settings: Settings,
    fields: Fields,
    bundle: Bundle,
    first: int,
    count: int,
    kept: Float[Tensor, "scenes n bins"] | None = None,
) -> Float[Tensor, "scenes {count} samples"]:
    """Where rays first … first + count of each scene are sampled.

    Args:
        kept: of all rays; the weights that are found of these are written into it.
    """
    rays = slice(first, first + count)
    if settings.importance_samples == 0:
        edges = uniform_edges(bundle.near[:, rays], bundle.far[:, rays], settings.uniform_samples)
        return in_bins(edges, None if bundle.jitter is None else bundle.jitter[:, rays]).contiguous()
    if bundle.coarse is not None:
        return merged_distances(settings, bundle, bundle.coarse[:, rays].contiguous(), first, even=True)
    weights = coarse_weights(settings, fields, bundle, first, count)
    if kept is not None:
        kept[:, rays] = weights
    return merged_distances(settings, bundle, weights, first)


def render(
    settings: Settings, fields: Fields, bundle: Bundle, keep_coarse: bool = False
) -> tuple[
    Float[Tensor, "scenes n 3"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n bins"] | None,
]:
    """Colour, opacity and depth; and, where asked for, the uniform samples' weights that samples were drawn from."""
    rgb, opacity, depth = (torch.empty_like(like) for like in (bundle.origins, bundle.near, bundle.near))
    kept = None
    if keep_coarse and settings.importance_samples > 0:
        kept = torch.empty(*bundle.near.shape, settings.uniform_samples, dtype=KEPT, device=rgb.device)
    for first, count in bundle.chunks(settings.points, settings.samples):
        _composite(
            lambda constants, count=count: (triton.cdiv(count, constants["R"]), len(fields.planes)),
            settings.ordered,
            **fields.arguments(settings),
            **bundle.arguments(),
            **_background(settings),
            distances=distances_along(settings, fields, bundle, first, count, kept),
            rgb=rgb,
            opacity=opacity,
            depth=depth,
            **_part(len(fields.planes), first, count, settings.samples),
        )
    return rgb, opacity, depth, kept


@dataclass(frozen=True)
class Gradients:
    """Of what was asked for; channels last for planes."""

    planes: Float[Tensor, "scenes 3 height width channels"] | None
    decoder: Float[Tensor, "scenes numbers"] | None
    origins: Float[Tensor, "scenes n 3"] | None
    directions: Float[Tensor, "scenes n 3"] | None


def gradients(
    settings: Settings,
    fields: Fields,
    bundle: Bundle,
    outputs: tuple[Tensor, Tensor, Tensor],
    d_outputs: tuple[Tensor, Tensor, Tensor],
    planes: bool,
    decoder: bool,
    rays: bool,
) -> Gradients:
    """Gradients from those of colour, opacity and depth.

    Args:
        planes, decoder, rays: whether theirs are asked for. The decoder's come as one row of numbers per scene:
            w1, b1, w2, b2 flattened.
    """
    device, (scenes, n) = fields.planes.device, bundle.near.shape
    hidden, channels = fields.w1.shape[-2:]
    programs = programs_per_scene(device, scenes, n)
    nothing = torch.empty(0, device=device)
    d_planes = torch.zeros_like(fields.planes, dtype=torch.float32) if planes else nothing
    numbers = hidden * channels + 5 * hidden + 4
    d_decoder = torch.zeros(scenes, programs, numbers, device=device) if decoder else nothing
    d_origins, d_directions = (torch.empty_like(bundle.origins) if rays else nothing for _ in range(2))
    ordered = planes and settings.ordered
    budget = settings.ordered_points if ordered else settings.points
    for first, count in bundle.chunks(budget, settings.samples):
        points = scenes * count * settings.samples
        kept = (nothing, nothing, nothing)
        if ordered:
            kept = (
                torch.empty(points, channels, device=device),
                torch.empty(3, points, dtype=torch.int32, device=device),
                torch.empty(3, points, 2, device=device),
            )
        _gradient(
            lambda constants: (programs, scenes),
            settings.ordered,
            **fields.arguments(settings),
            **bundle.arguments(),
            **_background(settings),
            distances=distances_along(settings, fields, bundle, first, count),
            **dict(zip(("rgb", "opacity", "depth"), outputs, strict=True)),
            **dict(zip(("d_rgb", "d_opacity", "d_depth"), d_outputs, strict=True)),
            d_planes=d_planes,
            d_decoder=d_decoder,
            d_origins=d_origins,
            d_directions=d_directions,
            **dict(zip(("d_features", "cells", "fractions"), kept, strict=True)),
            **_part(scenes, first, count, settings.samples),
            points=points,
            PLANES="ordered" if ordered else "atomic" if planes else "none",
            DECODER=decoder,
            RAYS=rays,
        )
        if ordered:
            add_cells(d_planes, *kept)
    return Gradients(
        d_planes if planes else None,
        d_decoder.sum(1) if decoder else None,
        d_origins if rays else None,
        d_directions if rays else None,
    )


def _jitter(bundle: Bundle) -> dict:
    if bundle.jitter is None:
        return {"jitter": bundle.near, "jitters": 0, "JITTER": False}
    return {"jitter": bundle.jitter, "jitters": bundle.jitter.shape[-1], "JITTER": True}


def _part(scenes: int, first: int, count: int, samples: int) -> dict:
    return {"first": first, "count": count, "samples": samples, "size_class": size_class(scenes * count * samples)}


def _background(settings: Settings) -> dict:
    opaque = settings.background is None
    return {"background": 0.0 if opaque else float(settings.background), "OPAQUE": opaque}
