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

SKIP = {"none": 0.0, "faint": 1e-3}
"""Choices of `Renderer.skip`, and the shares of the gradient that they may leave out."""


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
        return _interpolate(table, cells, weights, corners)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Float[Tensor, "n channels"]) -> tuple[Tensor, None, None, None]:
        return _spread(gradient, *ctx.saved_tensors, ctx.rows), None, None, None


class Faint(torch.autograd.Function):
    """The decoder's outputs at points, with a backward pass that leaves out those whose gradients are faint.

    Most of what is sampled is empty, hidden or right already: nine in ten points bring a thousandth of the gradient.
    A point is left out where the largest of its four gradients is at most `share` of the mean over all points, so that
    what is left out adds up to no more than `share` of all. Where a field is empty and should not be, gradients are
    not small beside the others: it grows. The bias gets all.
    """

    @staticmethod
    def forward(
        ctx,
        table: Float[Tensor, "rows hidden"],
        weight: Float[Tensor, "4 hidden"],
        bias: Float[Tensor, "4"],
        cells: Int32[Tensor, "n planes"],
        weights: Float[Tensor, "n planes 4"],
        corners: Int32[Tensor, "4"],
        share: float,
    ) -> Float[Tensor, "n 4"]:
        hidden = _interpolate(table, cells, weights, corners)
        ctx.save_for_backward(hidden, weight, cells, weights, corners)
        ctx.rows, ctx.share = len(table), share
        return torch.addmm(bias[:, None], weight, F.silu(hidden).mT).mT

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Float[Tensor, "n 4"]) -> tuple[Tensor | None, ...]:
        with full_precision(gradient.device):
            return *Faint._gradients(gradient, *ctx.saved_tensors, ctx.rows, ctx.share), None, None, None, None

    @staticmethod
    def _gradients(gradient, hidden, weight, cells, weights, corners, rows, share) -> tuple[Tensor, Tensor, Tensor]:
        most = gradient.mT.abs().amax(0)
        kept = torch.nonzero(~(most <= share * most.mean()))[:, 0]  # NaN is not faint
        hidden, cells, weights, some = (part[kept] for part in (hidden, cells, weights, gradient))
        before = torch.ops.aten.silu_backward(some @ weight, hidden)
        return _spread(before, cells, weights, corners, rows), some.mT @ F.silu(hidden), gradient.sum(0)


def _interpolate(table: Tensor, cells: Tensor, weights: Tensor, corners: Tensor) -> Float[Tensor, "n channels"]:
    rows = (cells[..., None] + corners).flatten(1)
    # detached: what a table that needs gradients has PyTorch note down for them is not used here
    return F.embedding_bag(rows, table.detach(), per_sample_weights=weights.flatten(1), mode="sum")


def _spread(
    gradient: Float[Tensor, "n channels"], cells: Tensor, weights: Tensor, corners: Tensor, rows: int
) -> Float[Tensor, "rows channels"]:
    """Return the gradient of `Interpolate`'s table."""
    order = cells.flatten().sort().indices
    counts = torch.bincount(cells.flatten(), minlength=rows)
    first = (counts.cumsum(0) - counts).int()  # of each cell's points, once they are sorted
    points = (order // cells.shape[1]).int()
    weights = weights.flatten(0, 1).index_select(0, order).mT.contiguous()
    gradient = gradient.contiguous()
    total = gradient.new_zeros(rows, gradient.shape[1])
    for corner, share in zip(corners.tolist(), weights, strict=True):
        summed = F.embedding_bag(points, gradient, first, per_sample_weights=share, mode="sum")
        total[corner:] += summed[: rows - corner]
    return total


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


def scene_by_scene(field: TriplaneField, faint: float = 0.0) -> list["CpuField"]:
    """Return one field for each scene of a batch: the texels of one scene fit a core's cache.

    Args:
        faint: see `CpuField`.
    """
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
        fields.append(CpuField(TriplaneField(alone, field.decoder), table, weight, bias, faint))
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
        faint: share of the gradient that may be left out, see `Faint`; 0 leaves nothing out.
    """

    field: TriplaneField
    table: Float[Tensor, "texels hidden"]
    weight: Float[Tensor, "4 hidden"]
    bias: Float[Tensor, "4"]
    faint: float = 0.0

    def __call__(
        self, points: Float[Tensor, "1 n 3"], directions: Float[Tensor, "1 n 3"] | None = None
    ) -> tuple[Float[Tensor, "1 n 3"], Float[Tensor, "1 n"]]:
        """See `Field`; the colour is the same from all directions."""
        with full_precision(points.device):
            coordinates, valid = self.field.triplane.frustum_coordinates(points)
            out = self._outputs(*self._cells(coordinates[0]))
        rgb, density = self.field.decoder.activated(out[None])
        return rgb, self.field.per_scene_unit(density, valid)

    def _outputs(self, *interpolation: Tensor) -> Float[Tensor, "n 4"]:
        if self.faint > 0 and torch.is_grad_enabled():
            return Faint.apply(self.table, self.weight, self.bias, *interpolation, self.faint)
        hidden = Interpolate.apply(self.table, *interpolation)
        hidden = F.silu(hidden, inplace=not torch.is_grad_enabled())
        return torch.addmm(self.bias[:, None], self.weight, hidden.mT).mT  # each of 4 numbers in a row of its own

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
