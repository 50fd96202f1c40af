"""The passes over rays: what is seen along them, the picture, and its gradients. Tensors in, tensors out."""

from dataclasses import dataclass

import torch
import triton
from jaxtyping import Float
from torch import Tensor

from nerfdiff.render.kernels.arguments import Bundle, Fields, Seen, Settings
from nerfdiff.render.kernels.cells import add_cells
from nerfdiff.render.kernels.composite import composite_gradient_kernel, composite_kernel
from nerfdiff.render.kernels.draw import draw_kernel
from nerfdiff.render.kernels.gradient import gradient_kernel
from nerfdiff.render.kernels.look import look_kernel
from nerfdiff.render.kernels.tuning import Launch, programs_per_scene, size_class
from nerfdiff.render.sampling import KEPT, in_bins, uniform_edges

_look = Launch(look_kernel, [{"R": 4, "S": 2, "num_warps": 1}, {"R": 8, "S": 2, "num_warps": 1}], {"R": 16, "S": 2})
# Runs take the most registers there are, and are faster where many samples fall into one cell.
_gradient = Launch(
    gradient_kernel,
    [{"R": 4, "RUNS": False, "num_warps": 1}, {"R": 4, "RUNS": True, "num_warps": 1}],
    {"R": 16, "RUNS": False},
    added_to=["d_table", "d_w2"],
)
RAYS = 32
"""Rays of a program that composites: a warp, a thread for each."""
SEGMENT = 32
"""Samples of a ray that a program takes, where it need not walk along all of them."""


def look(settings: Settings, fields: Fields, bundle: Bundle, first: int, count: int) -> Seen:
    """Along rays first … first + count of each scene."""
    device, scenes, uniform = bundle.near.device, len(bundle.near), settings.uniform_samples
    stop = settings.least_transmittance > 0
    values = torch.empty(scenes, count, settings.samples, 4, device=device)
    sums = torch.empty(scenes, count, uniform, device=device)
    stops = torch.empty(scenes, count, device=device) if stop else None

    def launch(distances: Tensor | None) -> None:
        segment = uniform if distances is None else SEGMENT
        pieces = 1 if distances is None else triton.cdiv(settings.importance_samples, SEGMENT)
        _look(
            lambda constants: (triton.cdiv(count, constants["R"]), scenes, pieces),
            settings.ordered,
            **fields.arguments(settings),
            shift=float(settings.density_shift),
            scale=float(settings.density_scale),
            **_rays(bundle),
            near=bundle.near,
            far=bundle.far,
            **_jitter(bundle),
            distances=values if distances is None else distances,
            values=values,
            cumulative=sums,
            stops=stops if stop else values,
            bound=float(settings.least_transmittance),
            uniform=uniform,
            segment=segment,
            **_part(scenes, first, count, settings.samples),
            FIRST=distances is None,
            STOP=stop,
        )

    launch(None)
    if settings.importance_samples == 0:
        rays = slice(first, first + count)
        edges = uniform_edges(bundle.near[:, rays], bundle.far[:, rays], uniform)
        distances = in_bins(edges, None if bundle.jitter is None else bundle.jitter[:, rays]).contiguous()
    else:
        distances = drawn_distances(settings, bundle, sums, first)
        launch(distances)
    return Seen(distances, values, stops, sums)


def drawn_distances(
    settings: Settings, bundle: Bundle, sums: Float[Tensor, "scenes count bins"], first: int, floor: float = 1e-2
) -> Float[Tensor, "scenes count samples"]:
    """Uniform, then importance samples of rays first … first + count of each scene.

    Args:
        sums: of the uniform samples' weights; of the bundle's own coarse weights afterwards, where it has some.
        floor: as of `importance_distances`.
    """
    scenes, count, bins = sums.shape
    distances = torch.empty(scenes, count, settings.samples, device=sums.device)
    uniform, padded = (max(16, triton.next_power_of_2(size)) for size in (bins, settings.importance_samples))
    rays = max(1, 128 // padded)
    draw_kernel[(triton.cdiv(count, rays), scenes)](
        given=sums if bundle.coarse is None else bundle.coarse,
        cumulative=sums,
        near=bundle.near,
        far=bundle.far,
        **_jitter(bundle),
        distances=distances,
        n=bundle.near.shape[1],
        first=first,
        count=count,
        uniform=bins,
        drawn=settings.importance_samples,
        floor=floor,
        EVEN=bundle.coarse is not None,
        UP=uniform,
        DP=padded,
        R=rays,
        num_warps=max(1, padded // 128),
    )
    return distances


def render(
    settings: Settings, fields: Fields, bundle: Bundle, keep_coarse: bool = False
) -> tuple[
    Float[Tensor, "scenes n 3"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n bins"] | None,
    Seen | None,
]:
    """Colour, opacity and depth; where asked for, the weights that samples were drawn from; and where all rays are
    taken at once, what was seen along them."""
    rgb, opacity, depth = (torch.empty_like(like) for like in (bundle.origins, bundle.near, bundle.near))
    kept, seen = None, None
    if keep_coarse and settings.importance_samples > 0:
        kept = torch.empty(*bundle.near.shape, settings.uniform_samples, dtype=KEPT, device=rgb.device)
    chunks = bundle.chunks(settings.points, settings.samples)
    for first, count in chunks:
        seen = look(settings, fields, bundle, first, count)
        if kept is not None:
            kept[:, first : first + count] = seen.sums.diff(dim=-1, prepend=torch.zeros_like(seen.sums[..., :1]))
        composite_kernel[(triton.cdiv(count, RAYS), len(fields.table))](
            **_walked(settings, bundle, seen),
            rgb=rgb,
            opacity=opacity,
            depth=depth,
            first=first,
            count=count,
        )
    return rgb, opacity, depth, kept, seen if len(chunks) == 1 else None


@dataclass(frozen=True)
class Gradients:
    """Compute the gradients that were asked for.

    Args:
        table: its units in the order of `texels.apart`.
    """

    table: Float[Tensor, "scenes 3 height width padded"] | None
    w2: Float[Tensor, "scenes 4 hidden"] | None
    b2: Float[Tensor, "scenes 4"]
    origins: Float[Tensor, "scenes n 3"] | None
    directions: Float[Tensor, "scenes n 3"] | None


def gradients(
    settings: Settings,
    fields: Fields,
    bundle: Bundle,
    seen: Seen | None,
    outputs: tuple[Tensor, Tensor, Tensor],
    d_outputs: tuple[Tensor, Tensor, Tensor],
    table: bool,
    w2: bool,
    rays: bool,
) -> Gradients:
    """Gradients from those of colour, opacity and depth.

    Args:
        seen: along all rays; None where that is to be found again.
        table, w2, rays: whether theirs are asked for.
    """
    device, (scenes, n), padded = fields.table.device, bundle.near.shape, fields.table.shape[-1]
    segment = settings.samples if rays else SEGMENT
    programs = programs_per_scene(device, scenes, n * triton.cdiv(settings.samples, segment))
    nothing = torch.empty(0, device=device)
    d_table = torch.zeros_like(fields.table, dtype=torch.float32) if table else nothing
    d_w2 = torch.zeros(scenes, programs, 4, padded, device=device) if w2 else nothing
    d_b2 = torch.zeros(scenes, 4, device=device)
    d_origins, d_directions = (torch.empty_like(bundle.origins) if rays else nothing for _ in range(2))
    ordered = table and settings.ordered
    chunks = bundle.chunks(settings.ordered_points if ordered else settings.points, settings.samples)
    for first, count in chunks:
        here = seen if seen is not None and len(chunks) == 1 else look(settings, fields, bundle, first, count)
        d_values = torch.empty_like(here.values)
        composite_gradient_kernel[(triton.cdiv(count, RAYS), scenes)](
            scene_near=fields.near,
            scene_far=fields.far,
            **_walked(settings, bundle, here),
            **dict(zip(("rgb", "opacity", "depth"), outputs, strict=True)),
            **dict(zip(("d_rgb", "d_opacity", "d_depth"), d_outputs, strict=True)),
            d_values=d_values,
            scale=float(settings.density_scale),
            first=first,
            count=count,
        )
        d_b2 += d_values.sum((1, 2))
        if not (table or w2 or rays):
            continue
        points = scenes * count * settings.samples
        kept = (nothing, nothing, nothing)
        if ordered:
            kept = (
                torch.empty(points, padded, device=device),
                torch.empty(3, points, dtype=torch.int32, device=device),
                torch.empty(3, points, 2, device=device),
            )
        _gradient(
            lambda constants: (programs, scenes),
            settings.ordered,
            **fields.arguments(settings),
            **_rays(bundle),
            distances=here.distances,
            d_values=d_values,
            d_table=d_table,
            d_w2=d_w2,
            d_origins=d_origins,
            d_directions=d_directions,
            **dict(zip(("d_features", "cells", "fractions"), kept, strict=True)),
            **_part(scenes, first, count, settings.samples),
            segment=segment,
            points=points,
            TABLE="ordered" if ordered else "atomic" if table else "none",
            DECODER=w2,
            RAYS=rays,
        )
        if ordered:
            add_cells(d_table, *kept)
    return Gradients(
        d_table if table else None,
        d_w2.sum(1)[..., : fields.w2.shape[-1]] if w2 else None,
        d_b2,
        d_origins if rays else None,
        d_directions if rays else None,
    )


def _rays(bundle: Bundle) -> dict:
    return {"origins": bundle.origins, "directions": bundle.directions, "n": bundle.near.shape[1]}


def _jitter(bundle: Bundle) -> dict:
    if bundle.jitter is None:
        return {"jitter": bundle.near, "jitters": 0, "JITTER": False}
    return {"jitter": bundle.jitter, "jitters": bundle.jitter.shape[-1], "JITTER": True}


def _part(scenes: int, first: int, count: int, samples: int) -> dict:
    return {"first": first, "count": count, "samples": samples, "size_class": size_class(scenes * count * samples)}


def _walked(settings: Settings, bundle: Bundle, seen: Seen) -> dict:
    """Return the arguments of kernels that composite."""
    opaque = settings.background is None
    return {
        "near": bundle.near,
        "far": bundle.far,
        "n": bundle.near.shape[1],
        "distances": seen.distances,
        "values": seen.values,
        "stops": seen.values if seen.stops is None else seen.stops,
        "uniform": settings.uniform_samples,
        "samples": settings.samples,
        "background": 0.0 if opaque else float(settings.background),
        "OPAQUE": opaque,
        "STOP": seen.stops is not None,
        "R": RAYS,
        "num_warps": 1,
    }
