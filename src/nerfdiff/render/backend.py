"""The choice of the renderer: fused kernels where they can do the same as the PyTorch reference, else the reference."""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from operator import attrgetter
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Rays
from nerfdiff.field.cpu_field import SKIP
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import Field, TriplaneField
from nerfdiff.render.agreement import Probe, disagreement, in_any_order
from nerfdiff.render.reference_gradients import reference_gradients
from nerfdiff.render.trusted import is_trusted, trust
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)

BACKENDS = ("auto", "torch", "triton")
PRECISIONS = ("auto", "ieee", "tf32x3", "tf32", "bf16")

Outputs = tuple[
    Float[Tensor, "batch n 3"],
    Float[Tensor, "batch n"],
    Float[Tensor, "batch n"],
    Float[Tensor, "batch n bins"] | None,
]

_WIDEST = 64
"""Hidden units for which a program's tiles fit registers."""
_MOST_DRAWN = 1024
"""Importance samples that a program holds at once."""
_POINTS_PER_QUERY = 16
"""The kernels keep 40 bytes of a sample where the reference's backward pass keeps 0.8 kB of a point."""

_COMPARED = ("cuda",)
"""Devices on which kernels are compared with the reference first. The interpreter's are tested beforehand."""

_warned: set[str] = set()
_failures: dict[tuple, str] = {}
_trusted: set[tuple] = set()


def check_choice(backend: str, kernel_precision: str, skip: str) -> None:
    """Raise ConfigError unless all are known."""
    known = (("backend", backend, BACKENDS), ("kernel_precision", kernel_precision, PRECISIONS), ("skip", skip, SKIP))
    for name, choice, choices in known:
        if choice not in choices:
            raise ConfigError(f"{name}={choice!r}: choose {', '.join(choices)}")


@torch.compiler.disable
def fused(
    renderer,
    field: Field,
    rays: Rays,
    jitter: Float[Tensor, "batch n samples"] | None,
    coarse: Float[Tensor, "batch n bins"] | None = None,
    keep_coarse: bool = False,
) -> Outputs | None:
    """Render by the fused kernels: the values of a `Rendering`; None where the reference has to render.

    `auto` takes the kernels for triplane fields on a GPU. Where they were wanted and cannot run, one line says why,
    once for each reason.
    """
    if not _wanted(renderer, field, rays):
        return None
    ordered = torch.are_deterministic_algorithms_enabled()
    found = (
        _obstacle(renderer, field, rays, jitter, coarse)
        or _distrust(renderer, field, rays, jitter, coarse, ordered)
        or _attempt(renderer, field, lambda: _render(renderer, field, rays, jitter, coarse, keep_coarse, ordered))
    )
    if not isinstance(found, str):
        return found
    _warn_once(found)
    return None


def chosen(renderer, field: Field, rays: Rays) -> str:
    """Return what renders these rays, `torch` or `triton`; certain after rendering, as kernels may not compile."""
    fits = _wanted(renderer, field, rays) and _obstacle(renderer, field, rays, None, None) is None
    return "triton" if fits else "torch"


def _wanted(renderer, field: Field, rays: Rays) -> bool:
    if renderer.backend == "auto":
        return rays.near.is_cuda and isinstance(field, TriplaneField)
    return renderer.backend == "triton"


def _warn_once(reason: str) -> None:
    if reason not in _warned:
        _warned.add(reason)
        log.warning("no fused rendering, the PyTorch reference takes over: %s", reason)


def _attempt(renderer, field: TriplaneField, kernels: Callable[[], Any]) -> Any:
    """Call kernels; return their values, or where they fail the reason."""
    try:
        return kernels()
    except torch.OutOfMemoryError:
        raise
    except Exception as error:
        return _note_failure(_kind(renderer, field), "the forward pass", error, field.triplane.planes.device)


def _note_failure(kind: tuple, what: str, error: Exception, device: torch.device) -> str:
    """Note a failure, so that kernels of this kind are not tried again; return the reason."""
    if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        # what breaks the recording of a graph may well run outside of one: who records decides
        raise error
    lines = str(error).strip().splitlines()
    _failures[kind] = f"{what} failed ({type(error).__name__}: {lines[0] if lines else 'no message'})"
    return _failures[kind]


def _kind(renderer, field: TriplaneField) -> tuple:
    """Return the values that compilation depends on."""
    planes, weight = field.triplane.planes, field.decoder.hidden.weight
    chosen = renderer.background is None, renderer.least_transmittance > 0, _half(renderer, planes.device)
    return planes.device, planes.shape[-2:], weight.shape[-2], weight.ndim, *chosen


@cache
def _missing() -> str | None:
    """Return why the kernels cannot be imported; None where they can."""
    try:
        import nerfdiff.render.kernels.function  # noqa: F401
    except ImportError as error:
        return f"triton cannot be imported ({error})"
    return None


def _interpreted() -> bool:
    from nerfdiff.render.kernels.tuning import INTERPRETED

    return INTERPRETED


def _obstacle(renderer, field: Field, rays: Rays, jitter: Tensor | None, coarse: Tensor | None) -> str | None:
    """Return why the kernels cannot render this as the reference does; None where they can."""
    if type(field) is not TriplaneField or type(field.decoder) is not Decoder:
        return "the field is not a triplane with this project's decoder"
    return (
        _missing()
        or _device_obstacle(field.triplane.planes.device)
        or _tensor_obstacle(renderer, field, rays, jitter, coarse)
    )


def _device_obstacle(device: torch.device) -> str | None:
    if device.type == "cpu":
        return None if _interpreted() else "on a CPU kernels run in Triton's interpreter only (TRITON_INTERPRET=1)"
    if device.type != "cuda":
        return f"no kernels for device {device}"
    capability = torch.cuda.get_device_capability(device)
    if capability < (8, 0):
        return f"compute capability {capability[0]}.{capability[1]}, kernels take 8.0 or newer"
    return None


def _tensor_obstacle(
    renderer, field: TriplaneField, rays: Rays, jitter: Tensor | None, coarse: Tensor | None
) -> str | None:
    triplane = field.triplane
    planes, parameters = triplane.planes, list(field.decoder.parameters())
    scenes, _, _, height, width = planes.shape
    hidden = field.decoder.hidden.weight.shape[-2]
    fixed = [rays.near, rays.far, triplane.near, triplane.far, triplane.cameras.K]
    fixed += [] if jitter is None else [jitter]
    exact = [rays.origins, rays.directions, *fixed]
    rough = [planes, *parameters] + ([] if coarse is None else [coarse])
    devices = {t.device for t in (*rough, *exact)}
    if len(devices) > 1:
        return f"tensors on {', '.join(sorted(map(str, devices)))}"
    halves = (torch.float32, torch.bfloat16, torch.float16)
    odd = {t.dtype for t in exact} - {torch.float32} | {t.dtype for t in rough} - set(halves)
    if odd:
        return f"no kernels for {', '.join(sorted(map(str, odd)))}"
    if rays.near.numel() == 0 or renderer.uniform_samples < 1 or renderer.importance_samples < 0:
        return "there is nothing to render"
    if len(rays.near) != scenes or any(t.ndim == 3 and len(t) != scenes for t in parameters):
        return f"{scenes} triplanes do not match the rays' or the decoders' batch"
    if jitter is not None and jitter.shape != (*rays.near.shape, renderer.samples_per_ray):
        return f"jitter of shape {tuple(jitter.shape)}"
    if hidden > _WIDEST or renderer.importance_samples > _MOST_DRAWN:
        return (
            f"{hidden} hidden units, {renderer.importance_samples} importance samples: "
            f"kernels take {_WIDEST} and {_MOST_DRAWN} at most"
        )
    if 3 * height * width * _WIDEST >= 2**31:
        return f"planes of {height} × {width} are too large to index"
    if torch.is_grad_enabled() and any(t.requires_grad for t in fixed):
        return "near, far, intrinsics and jitter get no gradients from kernels"
    return _failures.get(_kind(renderer, field))


def _half(renderer, device: torch.device) -> bool:
    """Return true if kernels compute in halves: where the reference's products would be."""
    if renderer.kernel_precision == "auto":
        return torch.is_autocast_enabled(device.type)
    return renderer.kernel_precision == "bf16"


def _distrust(renderer, field: TriplaneField, rays: Rays, jitter, coarse, ordered: bool) -> str | None:
    """Compare kernels that are used for the first time with the reference; return how they differ, or None.

    Errors of the reference are raised, and not held against the kernels.
    """
    kind, needs, device = _kind(renderer, field), _needs(field, rays), rays.near.device
    # what else kernels are compiled for
    way = (*kind, ordered, renderer.importance_samples, jitter is None, coarse is None)
    recording = device.type == "cuda" and torch.cuda.is_current_stream_capturing()
    if device.type not in _COMPARED or recording or (*way, needs) in _trusted:
        return None
    of = field.triplane.planes.shape[2], renderer.uniform_samples, *way[1:]
    if is_trusted(device, str((*of, needs))):
        _trusted.add((*way, needs))
        return None
    plain, values = replace(renderer, backend="torch"), attrgetter("rgb", "opacity", "depth")
    with in_any_order():
        probe = Probe.like(field, rays, jitter, coarse, renderer.samples_per_ray, needs)
        kernels = partial(probe.outputs, lambda *given: _render(renderer, *given, False, ordered)[:3])
        found = _attempt(renderer, field, kernels)
        if isinstance(found, str):
            return found
        expected = probe.outputs(lambda *given: values(plain.render(*given)))
    # of a backward pass that failed, the reference's gradients were found
    reason = _failures.get(kind) or disagreement(found, expected)
    if reason is not None:
        _failures[kind] = reason
        return reason
    passed = {needs, (False, False, False)}
    _trusted.update((*way, own) for own in passed)
    trust(device, [str((*of, own)) for own in passed])
    return None


def _needs(field: TriplaneField, rays: Rays) -> tuple[bool, ...]:
    """Return true for planes, decoder and rays if they get gradients."""
    groups = [field.triplane.planes], field.decoder.parameters(), [rays.origins, rays.directions]
    return tuple(torch.is_grad_enabled() and any(t.requires_grad for t in group) for group in groups)


def _render(renderer, field: TriplaneField, rays: Rays, jitter, coarse, keep_coarse: bool, ordered: bool) -> Outputs:
    from nerfdiff.render.kernels.arguments import Settings
    from nerfdiff.render.kernels.function import fused_render

    triplane, decoder = field.triplane, field.decoder
    settings = Settings(
        uniform_samples=renderer.uniform_samples,
        importance_samples=renderer.importance_samples,
        background=renderer.background,
        points=_POINTS_PER_QUERY * renderer.chunk,
        ordered_points=renderer.chunk,
        half=_half(renderer, triplane.planes.device),
        ordered=ordered,
        image_width=triplane.cameras.width,
        image_height=triplane.cameras.height,
        density_shift=decoder.density_shift,
        density_scale=decoder.density_scale,
        least_transmittance=renderer.least_transmittance,
    )
    kind = _kind(renderer, field)

    def recover(error, tensors, d_outputs, needed):
        _warn_once(_note_failure(kind, "the backward pass", error, triplane.planes.device))
        return reference_gradients(renderer, field, settings.half, tensors, d_outputs, needed)

    return fused_render(
        settings,
        recover,
        keep_coarse,
        triplane.planes,
        *(getattr(layer, name) for layer in (decoder.hidden, decoder.output) for name in ("weight", "bias")),
        rays.origins,
        rays.directions,
        triplane.cameras.K,
        triplane.near,
        triplane.far,
        rays.near,
        rays.far,
        jitter,
        coarse,
    )
