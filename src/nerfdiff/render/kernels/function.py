"""The fused renderer as one differentiable operation."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfdiff.render.kernels.arguments import Bundle, Fields, Settings
from nerfdiff.render.kernels.passes import Gradients, gradients, render

Outputs = tuple[
    Float[Tensor, "scenes n 3"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n bins"] | None,
]


class FusedRender(torch.autograd.Function):
    """Colour, opacity and depth of rays through triplane fields.

    Saved for the backward pass: the arguments, and the picture. Where to look along each ray is found again.
    """

    @staticmethod
    def forward(ctx, settings, recover, keep_coarse, *tensors):
        with torch.cuda.device_of(tensors[0]):  # kernels start on the current device
            *outputs, kept = render(settings, *_packed(settings, tensors), keep_coarse)
        ctx.settings, ctx.recover = settings, recover
        ctx.save_for_backward(*tensors, *outputs)
        if kept is not None:
            ctx.mark_non_differentiable(kept)
        return *outputs, kept

    @staticmethod
    @once_differentiable
    def backward(ctx, *d_outputs):
        tensors, outputs, d_outputs = ctx.saved_tensors[:-3], ctx.saved_tensors[-3:], d_outputs[:3]
        needed = ctx.needs_input_grad[3:10]
        try:
            with torch.cuda.device_of(tensors[0]):
                found = _gradients(ctx.settings, tensors, outputs, d_outputs, needed)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            found = ctx.recover(error, tensors, d_outputs, needed)
        return None, None, None, *found, *(None,) * (len(tensors) - len(found))


def fused_render(
    settings: Settings,
    recover: Callable,
    keep_coarse: bool,
    planes: Float[Tensor, "scenes 3 channels height width"],
    w1: Float[Tensor, "*decoders hidden channels"],
    b1: Float[Tensor, "*decoders hidden"],
    w2: Float[Tensor, "*decoders 4 hidden"],
    b2: Float[Tensor, "*decoders 4"],
    origins: Float[Tensor, "scenes n 3"],
    directions: Float[Tensor, "scenes n 3"],
    K: Float[Tensor, "scenes 3 3"],
    scene_near: Float[Tensor, "scenes"],
    scene_far: Float[Tensor, "scenes"],
    near: Float[Tensor, "scenes n"],
    far: Float[Tensor, "scenes n"],
    jitter: Float[Tensor, "scenes n samples"] | None,
    coarse: Float[Tensor, "scenes n bins"] | None,
) -> Outputs:
    """The values of a `Rendering` of rays in the input cameras' space, as `Renderer` defines them.

    Differentiable, once, in planes, decoder (w1, b1, w2, b2), origins and directions; not in what follows them.

    Args:
        recover: called where the backward pass fails, with the error, the 14 tensors, the outputs' gradients and
            which of the first 7 need one; returns those gradients.
        keep_coarse, coarse: as of `Renderer.render`.
    """
    tensors = (planes, w1, b1, w2, b2, origins, directions, K, scene_near, scene_far, near, far, jitter, coarse)
    return FusedRender.apply(settings, recover, keep_coarse, *tensors)


def _packed(settings: Settings, tensors: tuple[Tensor | None, ...]) -> tuple[Fields, Bundle]:
    """As the kernels read them: planes channels last, and everything contiguous."""
    planes, w1, b1, w2, b2, origins, directions, K, scene_near, scene_far, near, far, jitter, coarse = tensors
    stored = torch.bfloat16 if settings.precision == "bf16" else torch.float32
    planes = planes.movedim(2, -1).to(stored, memory_format=torch.contiguous_format).contiguous()
    frustum = (value.float().contiguous() for value in (K, scene_near, scene_far))
    decoder = (value.contiguous() for value in (w1, b1, w2, b2))
    rays = (value.contiguous() for value in (origins, directions, near, far))
    more = (None if value is None else value.contiguous() for value in (jitter, coarse))
    return Fields(planes, *frustum, *decoder), Bundle(*rays, *more)


def _gradients(
    settings: Settings,
    tensors: tuple[Tensor | None, ...],
    outputs: tuple[Tensor, ...],
    d_outputs: tuple[Tensor, ...],
    needed: tuple[bool, ...],
) -> list[Tensor | None]:
    """Of the first 7 tensors, where needed."""
    fields, bundle = _packed(settings, tensors)
    found = gradients(
        settings,
        fields,
        bundle,
        outputs,
        tuple(value.contiguous() for value in d_outputs),
        planes=needed[0],
        decoder=any(needed[1:5]),
        rays=any(needed[5:7]),
    )
    planes = None if found.planes is None else found.planes.movedim(-1, 2)
    values = [planes, *_decoder_gradients(found, fields), found.origins, found.directions]
    return [
        value.to(like.dtype) if need else None for value, like, need in zip(values, tensors[:7], needed, strict=True)
    ]


def _decoder_gradients(found: Gradients, fields: Fields) -> list[Tensor | None]:
    parameters = (fields.w1, fields.b1, fields.w2, fields.b2)
    if found.decoder is None:
        return [None] * 4
    numbers = found.decoder.sum(0) if fields.shared else found.decoder
    sizes = [value.numel() // (1 if fields.shared else len(value)) for value in parameters]
    return [part.reshape(value.shape) for part, value in zip(numbers.split(sizes, -1), parameters, strict=True)]
