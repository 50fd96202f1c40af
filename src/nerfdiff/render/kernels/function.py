"""The fused renderer as one differentiable operation."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfdiff.render.kernels.arguments import Bundle, Fields, Seen, Settings
from nerfdiff.render.kernels.passes import gradients, render
from nerfdiff.render.kernels.texels import hidden_texels, texel_gradients

Outputs = tuple[
    Float[Tensor, "scenes n 3"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n"],
    Float[Tensor, "scenes n bins"] | None,
]


class FusedRender(torch.autograd.Function):
    """Colour, opacity and depth of rays through triplane fields.

    Saved for the backward pass: the arguments, texels after the hidden layer, the picture, and what was seen along
    the rays if that is no more than memory is to hold; else it is looked for again.
    """

    @staticmethod
    def forward(ctx, settings, recover, keep_coarse, *tensors):
        with torch.cuda.device_of(tensors[0]):  # kernels start on the current device
            table = hidden_texels(*tensors[:3], settings.half)
            *outputs, kept, seen = render(settings, *_packed(table, tensors), keep_coarse)
        ctx.settings, ctx.recover = settings, recover
        ctx.save_for_backward(*tensors, *outputs, table, *(() if seen is None else vars(seen).values()))
        if kept is not None:
            ctx.mark_non_differentiable(kept)
        return *outputs, kept

    @staticmethod
    @once_differentiable
    def backward(ctx, *d_outputs):
        saved, d_outputs = ctx.saved_tensors, d_outputs[:3]
        tensors, outputs, table, seen = saved[:14], saved[14:17], saved[17], saved[18:]
        needed = ctx.needs_input_grad[3:10]
        try:
            with torch.cuda.device_of(tensors[0]):
                found = _gradients(
                    ctx.settings, tensors, table, Seen(*seen) if seen else None, outputs, d_outputs, needed
                )
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


def _packed(table: Tensor, tensors: tuple[Tensor | None, ...]) -> tuple[Fields, Bundle]:
    """Make tensors contiguous, as the kernels read them."""
    _, _, _, w2, b2, origins, directions, K, scene_near, scene_far, near, far, jitter, coarse = tensors
    frustum = (value.float().contiguous() for value in (K, scene_near, scene_far))
    rays = (value.contiguous() for value in (origins, directions, near, far))
    more = (None if value is None else value.contiguous() for value in (jitter, coarse))
    return Fields(table, *frustum, w2.contiguous(), b2.contiguous()), Bundle(*rays, *more)


def _gradients(
    settings: Settings,
    tensors: tuple[Tensor | None, ...],
    table: Tensor,
    seen: Seen | None,
    outputs: tuple[Tensor, ...],
    d_outputs: tuple[Tensor, ...],
    needed: tuple[bool, ...],
) -> list[Tensor | None]:
    """Compute gradients of the first 7 tensors, where needed."""
    planes, w1, _, w2 = tensors[:4]
    found = gradients(
        settings,
        *_packed(table, tensors),
        seen,
        outputs,
        tuple(value.contiguous() for value in d_outputs),
        table=any(needed[:3]),
        w2=needed[3],
        rays=any(needed[5:7]),
    )
    first = (None, None, None)
    if found.table is not None:
        first = texel_gradients(found.table, planes, w1, needed[0], any(needed[1:3]))
    last = (d if d is None or w2.ndim == 3 else d.sum(0) for d in (found.w2, found.b2))
    values = (*first, *last, found.origins, found.directions)
    return [
        value.to(like.dtype) if need else None for value, like, need in zip(values, tensors[:7], needed, strict=True)
    ]
