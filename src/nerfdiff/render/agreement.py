"""Check once, before fused kernels are used on a device, that they render what the reference renders."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.cameras import Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane

SCENES, RAYS = 2, 64
"""Compared at most: the first scenes, and of each, rays spread evenly over those to render."""
OPTICAL_DEPTH = 4.0
"""Optical depth of the probe's frustum, about: its front is the most visible, so importance samples are not uniform."""
CONTRAST = 0.5
"""Contrast of the probe's densities before the softplus; gaps would let rounding move importance samples far."""

# Three and a half times or more what rounding did in the worst case to probes of nine sizes and five seeds seen by 64
# rays (decoders under bf16 autocast or not, planes rounded to bf16 or not) and of four sizes in Triton's interpreter:
# colours 0.0017, opacities 0.0009, depths 0.0011; of gradients, planes 0.053, hidden weights 0.035, the decoder's
# others 0.015, rays 0.16. Without importance sampling one of them at least was exceeded by a tenth or more. Means and
# lengths, not greatest differences: where a rounded coarse weight crosses a quantile, samples of one ray jump.
VALUES = {"colours": 0.006, "opacities": 0.006, "depths": 0.005}
"""Mean differences above which kernels are not trusted: depths in lengths of the rays, weighted by opacity."""
GRADIENTS = {
    "planes": 0.2,
    "hidden.weight": 0.15,
    "hidden.bias": 0.1,
    "output.weight": 0.1,
    "output.bias": 0.1,
    "origins": 0.7,
    "directions": 0.7,
}
"""Differences of gradients above which kernels are not trusted, in lengths of the reference's gradient."""
NOTHING = 1e-5
"""Length below which a gradient counts as rounding; those of 64 rays were 5e-3 to 10 where not zero."""

# field, rays, jitter, coarse weights -> colours, opacity, depth
Render = Callable[
    [TriplaneField, Rays, Tensor | None, Tensor | None],
    tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"], Float[Tensor, "batch n"]],
]


@dataclass(frozen=True)
class Probe:
    """A random field and rays through it, of the sizes and types of those to be rendered.

    A field to render may be empty (importance samples are then uniform), or so sharp that rounding shows. This one
    tells wrong kernels from rounding in any case.

    Args:
        jitter, coarse: as of `Renderer.render`.
        leaves: tensors by name whose gradients are compared.
    """

    field: TriplaneField
    rays: Rays
    jitter: Float[Tensor, "batch n samples"] | None
    coarse: Float[Tensor, "batch n bins"] | None
    leaves: dict[str, Tensor]

    @staticmethod
    def like(
        field: TriplaneField,
        rays: Rays,
        jitter: Float[Tensor, "batch n samples"] | None,
        coarse: Float[Tensor, "batch n bins"] | None,
        samples: int,
        needs: Sequence[bool],
    ) -> "Probe":
        """Make a probe like this field and some of these rays.

        Args:
            samples: per ray; the field varies from sample to sample, so that it shows where they are.
            needs: true for planes, decoder and rays if they are to have gradients.
        """
        device, count = rays.near.device, rays.near.shape[1]
        source = torch.Generator(device).manual_seed(0)  # a run's own random numbers stay as they are
        some = torch.linspace(0, count - 1, min(RAYS, count), device=device).long()

        def drawn(like: Tensor | None, power: int) -> Tensor | None:
            if like is None:
                return None
            values = torch.rand(*few.near.shape, like.shape[-1], device=device, generator=source)
            return values.pow(power).to(like.dtype)

        few = Rays(*(part.detach()[:SCENES, some] for part in vars(rays).values()))
        triplane, decoder = _random_triplane(field.triplane, samples, source), _random_decoder(field.decoder, source)
        groups = (
            {"planes": triplane.planes},
            dict(decoder.named_parameters()),
            {"origins": few.origins, "directions": few.directions},
        )
        leaves = {}
        for group, needed in zip(groups, needs, strict=True):
            leaves |= group if needed else {}
        for leaf in leaves.values():
            leaf.requires_grad_()
        return Probe(TriplaneField(triplane, decoder), few, drawn(jitter, 1), drawn(coarse, 4), leaves)

    def outputs(self, render: Render) -> dict[str, Tensor]:
        """Return colours, opacities and depths (of the rays' lengths), and gradients of a randomly weighted sum."""
        with torch.set_grad_enabled(bool(self.leaves)):
            colours, opacity, depth = render(self.field, self.rays, self.jitter, self.coarse)
            values = dict(zip(VALUES, (colours, opacity, depth / (self.rays.far - self.rays.near)), strict=True))
        if not self.leaves:
            return values
        source = torch.Generator(depth.device).manual_seed(1)
        weights = [torch.rand(v.shape, device=v.device, generator=source) / depth.numel() for v in values.values()]
        gradients = torch.autograd.grad(list(values.values()), list(self.leaves.values()), weights)
        return {name: v.detach() for name, v in values.items()} | dict(zip(self.leaves, gradients, strict=True))


def disagreement(found: dict[str, Tensor], expected: dict[str, Tensor]) -> str | None:
    """Say how the kernels' outputs differ from the reference's by more than rounding; None where they do not.

    Waits for the device.
    """
    differences = {}
    for name, value in found.items():
        difference, truth = (value - expected[name]).float(), expected[name].float()
        if name == "depths":
            difference = difference * expected["opacities"]  # a ray that meets nothing has no depth to speak of
        differences[name] = (
            difference.abs().mean() if name in VALUES else difference.norm() / truth.norm().clamp_min(NOTHING)
        )
    for name, difference in zip(differences, torch.stack(list(differences.values())).tolist(), strict=True):
        if name in VALUES and not difference <= VALUES[name]:  # NaN is a difference
            return f"their {name} differ from the reference's by {difference:.3g} on average"
        if name in GRADIENTS and not difference <= GRADIENTS[name]:
            return f"their gradients of {name} differ from the reference's by {difference:.3g} of its length"
    return None


@contextmanager
def in_any_order() -> Iterator[None]:
    """Allow sums in any order: on a GPU the reference has no other way, and raises where determinism is asked."""
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])


def _random_triplane(like: Triplane, samples: int, source: torch.Generator) -> Triplane:
    """Make noise as fine as the samples along a ray, or as the planes."""
    some = slice(SCENES)
    shape, device = like.planes[some].shape, like.planes.device
    cells = [min(samples, side) for side in shape[-2:]]
    noise = 2 * torch.randn(shape[0] * 3, shape[2], *cells, device=device, generator=source)
    planes = F.interpolate(noise, shape[-2:], mode="bilinear", align_corners=False).reshape(shape)
    return Triplane(planes.to(like.planes.dtype), like.cameras[some], like.near[some], like.far[some])


def _random_decoder(like: Decoder, source: torch.Generator) -> Decoder:
    with torch.device("meta"):  # where nothing is drawn
        decoder = Decoder(**like.settings)
    mean = OPTICAL_DEPTH / like.density_scale
    for name, layer in decoder.named_children():
        for part, value in getattr(like, name).named_parameters():
            shape = (value[:SCENES] if like.hidden.weight.ndim == 3 else value).shape
            own = torch.randn(shape, device=value.device, generator=source)
            own *= shape[-1] ** -0.5 if part == "weight" else 1.0
            if name == "output" and part == "weight":
                own[..., 3, :] *= CONTRAST
            elif name == "output":
                own[..., 3] = mean + math.log(-math.expm1(-mean)) - like.density_shift  # the inverse of softplus
            setattr(layer, part, nn.Parameter(own.to(value.dtype), requires_grad=False))
    return decoder
