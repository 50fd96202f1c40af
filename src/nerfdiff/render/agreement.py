"""Whether this device's kernels show what the reference shows: looked at once, before they are trusted."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Rays
from nerfdiff.field.field import TriplaneField

RAYS = 64
"""Of each scene that are compared, spread evenly over those to render."""
COLOURS = 0.02
"""Mean difference of colours in [0, 1] above which kernels are not trusted."""
GRADIENTS = 0.2
"""Likewise the difference of the planes' gradients, in lengths of the reference's."""

# field, rays, jitter -> colours
Render = Callable[[TriplaneField, Rays, Tensor | None], Float[Tensor, "batch n 3"]]


def disagreement(
    kernels: Render,
    reference: Render,
    field: TriplaneField,
    rays: Rays,
    jitter: Float[Tensor, "batch n samples"] | None,
    with_gradients: bool,
) -> str | None:
    """How kernels differ from the reference by more than rounding does; None where they agree. Waits for the device.

    Args:
        with_gradients: compare those of the planes too.
    """
    some = torch.linspace(0, rays.near.shape[1] - 1, min(RAYS, rays.near.shape[1]), device=rays.near.device).long()
    few = Rays(*(part.detach()[:, some] for part in vars(rays).values()))
    jitter = None if jitter is None else jitter[:, some]
    seen = [_look(render, field, few, jitter, with_gradients) for render in (kernels, reference)]
    (colours, gradient), (expected, expected_gradient) = seen
    difference = float((colours - expected).abs().mean())
    if not difference <= COLOURS:  # NaN is a difference
        return f"their colours differ from the reference's by {difference:.3g} on average"
    if with_gradients:
        difference = float((gradient - expected_gradient).norm() / expected_gradient.norm().clamp_min(1e-12))
        if not difference <= GRADIENTS:
            return f"their gradients differ from the reference's by {difference:.3g} of its length"
    return None


def _look(render, field, rays, jitter, with_gradients):
    """Colours, and the planes' gradient of their mean square."""
    planes = field.triplane.planes.detach().requires_grad_(with_gradients)
    own = replace(field, triplane=replace(field.triplane, planes=planes))
    with torch.set_grad_enabled(with_gradients):
        colours = render(own, rays, jitter)
        gradient = torch.autograd.grad(colours.square().mean(), planes)[0] if with_gradients else None
    return colours.detach(), gradient
