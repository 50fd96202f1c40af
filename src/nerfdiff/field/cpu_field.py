"""A triplane field as a CPU computes it fastest: `TriplaneField`'s numbers, up to rounding."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfdiff.cameras import Rays
from nerfdiff.field.field import Field, TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.utils.precision import full_precision


class Interpolate(torch.autograd.Function):
    """Σ_p Σ_k w_pk · table[cell_p + corner_k]: over the planes p, and in each over the four corners of a cell.

    One `embedding_bag` sums the rows without keeping them. Its own backward pass adds to the table's gradient row
    by row; here points are sorted by cell, which makes every corner's share one `embedding_bag` over points, and takes
    a fifth of the time (measured, 24576 points in planes of 32 x 32). Gradients go to the table alone.
    """

    @staticmethod
    def forward(
        ctx,
        table: Float[Tensor, "rows channels"],
        cells: Int32[Tensor, "n planes"],
        weights: Float[Tensor, "n planes 4"],
        corners: Int32[Tensor, "4"],
    ) -> Float[Tensor, "n channels"]:
        ctx.save_for_backward(cells, weights, corners)
        ctx.rows = len(table)
        rows = (cells[..., None] + corners).flatten(1)
        return F.embedding_bag(rows, table, per_sample_weights=weights.flatten(1), mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Float[Tensor, "n channels"]) -> tuple[Tensor, None, None, None]:
        cells, weights, corners = ctx.saved_tensors
        order = cells.flatten().sort().indices
        counts = torch.bincount(cells.flatten(), minlength=ctx.rows)
        first = (counts.cumsum(0) - counts).int()  # of each cell's points, once they are sorted
        points = (order // cells.shape[1]).int()
        weights = weights.flatten(0, 1).index_select(0, order).mT.contiguous()
        gradient = gradient.contiguous()
        total = gradient.new_zeros(ctx.rows, gradient.shape[1])
        for corner, share in zip(corners.tolist(), weights, strict=True):
            summed = F.embedding_bag(points, gradient, first, per_sample_weights=share, mode="sum")
            total[corner:] += summed[: ctx.rows - corner]
        return total, None, None, None


def suits(field: Field, rays: Rays) -> bool:
    """Return true if `scene_by_scene` can stand for this field along these rays.

    It can on a CPU, in fp32 (float64 is for references), where gradients go to planes and decoder alone.
    """
    if not isinstance(field, TriplaneField):
        return False
    triplane, used = field.triplane, field.decoder.hidden.weight
    geometry = (triplane.cameras.K, triplane.near, triplane.far, *vars(rays).values())
    return (
        all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in (triplane.planes, used))
        and all(tensor.dtype == torch.float32 for tensor in geometry)
        and not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in geometry))
    )


def scene_by_scene(field: TriplaneField) -> list["CpuField"]:
    """Return one field for each scene of a batch: the texels of one scene fit a core's cache."""
    triplane, hidden, output = field.triplane, field.decoder.hidden, field.decoder.output
    with full_precision(triplane.planes.device):
        texels = triplane.planes.permute(0, 1, 3, 4, 2).flatten(1, 3)
        # a point's weights add up to 1 in each plane: each brings a third of the bias
        tables = texels @ hidden.weight.mT + hidden.bias[..., None, :] / 3
    fields = []
    for scene, table in enumerate(tables.unbind()):
        one = slice(scene, scene + 1)
        alone = Triplane(triplane.planes[one], triplane.cameras[one], triplane.near[one], triplane.far[one])
        own = output.weight.ndim == 3  # a decoder for each scene
        weight, bias = (parameter[scene] if own else parameter for parameter in (output.weight, output.bias))
        fields.append(CpuField(TriplaneField(alone, field.decoder), table, weight, bias))
    return fields


@dataclass(frozen=True)
class CpuField:
    """Colour and density of the points of one scene.

    The hidden layer is linear in the features, and features are weighted sums of texels: it is applied to every
    texel once, instead of to every point. A point is then one weighted sum of 12 rows.

    Args:
        field: of one scene.
        table: its texels after the decoder's hidden layer, before the activation.
        weight, bias: of the decoder's output layer.
    """

    field: TriplaneField
    table: Float[Tensor, "texels hidden"]
    weight: Float[Tensor, "4 hidden"]
    bias: Float[Tensor, "4"]

    def __call__(
        self, points: Float[Tensor, "1 n 3"], directions: Float[Tensor, "1 n 3"] | None = None
    ) -> tuple[Float[Tensor, "1 n 3"], Float[Tensor, "1 n"]]:
        """See `Field`; the colour is the same from all directions."""
        with full_precision(points.device):
            coordinates, valid = self.field.triplane.frustum_coordinates(points)
            hidden = F.silu(Interpolate.apply(self.table, *self._cells(coordinates[0])))
            out = torch.addmm(self.bias[:, None], self.weight, hidden.mT)  # each of 4 numbers in a row of its own
        rgb, density = self.field.decoder.activated(out.mT[None])
        return rgb, self.field.per_scene_unit(density, valid)

    def _cells(
        self, coordinates: Float[Tensor, "n 3"]
    ) -> tuple[Int32[Tensor, "n 3"], Float[Tensor, "n 3 4"], Int32[Tensor, "4"]]:
        """Return, per plane, the row of a cell's first corner and the weights of all four; and the rows' offsets."""
        height, width = self.field.triplane.planes.shape[-2:]
        x, y, z = coordinates.unbind(-1)
        column, row = _between(x, width), _between(y, height)
        z_row = _between(z, height)
        z_column = z_row if height == width else _between(z, width)
        cells, weights = [], []
        # as `Triplane.sample` lays them out: z runs along the height of xz and along the width of yz
        for plane, (down, right) in enumerate(((row, column), (z_row, column), (row, z_column))):
            cells.append((down.first + plane * height) * width + right.first)
            weights += [v * u for v in (down.left, down.past) for u in (right.left, right.past)]
        right, down = min(1, width - 1), width * min(1, height - 1)
        corners = torch.tensor([0, right, down, down + right], dtype=torch.int32)
        return torch.stack(cells, -1), torch.stack(weights, -1).unflatten(-1, (3, 4)), corners


class _Between(NamedTuple):
    """The first of two texels, and the shares of it and of the next."""

    first: Int32[Tensor, "n"]
    left: Float[Tensor, "n"]
    past: Float[Tensor, "n"]


def _between(coordinate: Float[Tensor, "n"], texels: int) -> _Between:
    """Place a coordinate between texels of an axis whose outer edges are -1 and 1; the border texels continue."""
    position = (0.5 * texels * (coordinate + 1) - 0.5).clamp(0, texels - 1)
    first = position.int().clamp(0, max(0, texels - 2))
    past = position - first
    return _Between(first, 1 - past, past)
