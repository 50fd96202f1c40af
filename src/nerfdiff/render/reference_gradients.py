"""Gradients by the PyTorch reference for renderings of the fused kernels."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfdiff.cameras import Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane


def reference_gradients(
    renderer,
    field: TriplaneField,
    half: bool,
    tensors: Sequence[Tensor | None],
    d_outputs: Sequence[Tensor],
    needed: Sequence[bool],
) -> list[Tensor | None]:
    """Compute gradients of the first 7 tensors where needed, for a rendering whose own backward pass failed.

    Args:
        renderer, field: of the rendering.
        half: true if it was made in half precision.
        tensors: the 14 of `fused_render`.
        d_outputs: gradients of colour, opacity and depth.
    """
    leaves = [tensor.detach().requires_grad_() for tensor in tensors[:7]]
    planes, *parameters, origins, directions = leaves
    _, near, far, ray_near, ray_far, jitter, coarse = tensors[7:]
    decoder = Decoder(**field.decoder.settings)
    for i, layer in enumerate((decoder.hidden, decoder.output)):
        layer.weight, layer.bias = (nn.Parameter(value.detach()) for value in parameters[2 * i : 2 * i + 2])
    leaves[1:5] = [decoder.hidden.weight, decoder.hidden.bias, decoder.output.weight, decoder.output.bias]
    with torch.enable_grad(), torch.autocast(planes.device.type, torch.bfloat16, enabled=half):
        again = TriplaneField(Triplane(planes, field.triplane.cameras, near, far), decoder)
        rays = Rays(origins, directions, ray_near, ray_far)
        out = replace(renderer, backend="torch").render(again, rays, jitter, coarse)
    wanted = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
    found = iter(torch.autograd.grad((out.rgb, out.opacity, out.depth), wanted, d_outputs))
    return [next(found) if need else None for need in needed]
