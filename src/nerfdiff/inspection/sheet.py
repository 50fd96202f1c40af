"""The contact sheet: rows are scenes, columns views; the input view in a frame, with its mask and depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, pad

from nerfdiff.data.scene import Scene
from nerfdiff.results.pictures import colour_depth, contact_sheet
from nerfdiff.utils.spread import spread

FRAME = (0.85, 0.1, 0.1)


@dataclass(frozen=True)
class Row:
    """One scene's pictures.

    Args:
        names: of the views that `images` shows, without the scene's where they begin with it.
        source: position of the input view in `images`.
    """

    scene: str
    names: tuple[str, ...]
    images: Float[Tensor, "views 3 h w"]
    source: int | None
    mask: Float[Tensor, "3 h w"] | None
    depth: Float[Tensor, "3 h w"] | None


def row_of(scene: Scene, source: int | None, views: int) -> Row:
    """Some views of a scene, the input view (at position `source` of it) first; none where `views` is 0."""
    shown = [view for view in spread(len(scene.views), views) if view != source]
    shown = shown if source is None else [source, *shown][:views]
    mask = depth = None
    if shown and scene.mask is not None:
        mask = scene.mask[shown[0]].float().expand(3, -1, -1)
    if shown and scene.depth is not None:
        first = scene.depth[shown[:1]]
        seen = first > 0
        # the range of what is there: far may be the horizon
        low, high = (first[seen].min().item(), first[seen].max().item()) if seen.any() else (scene.near, scene.far)
        depth = colour_depth(first, low, max(high, low * (1 + 1e-6)), seen.float())[0]
    first = None if source is None or not shown else 0
    return Row(
        scene.id,
        tuple(scene.views[v].removeprefix(scene.id).lstrip("_-") or scene.views[v] for v in shown),
        scene.pixels[shown].float() / 255,
        first,
        mask,
        depth,
    )


def write_sheet(path: Path, rows: Sequence[Row], max_cell: int, min_cell: int) -> Path | None:
    """Save the contact sheet; None where there is nothing to show.

    Args:
        max_cell: pixels; larger images are reduced to it.
        min_cell: pixels; smaller images are enlarged by a whole factor to it.
    """
    rows = [row for row in rows if len(row.images)]
    if not rows:
        return None
    sides = torch.tensor([row.images.shape[-2:] for row in rows]).amax(0).double()
    sides *= min(1.0, max_cell / sides.max().item())
    size = tuple(max(1, round(side)) for side in sides.tolist())
    columns = {}
    for column in range(max(len(row.images) for row in rows)):
        cells = [
            _framed(row.images[column], size, column == row.source) if column < len(row.images) else None
            for row in rows
        ]
        columns[_heading(rows, column)] = cells
    for name in ("mask", "depth"):
        cells = [None if getattr(row, name) is None else _framed(getattr(row, name), size, False) for row in rows]
        if any(cell is not None for cell in cells):
            columns[f"its {name}" if rows[0].source == 0 else f"{name} of the first"] = cells
    blank = torch.ones_like(next(cell for cell in columns[_heading(rows, 0)] if cell is not None))
    pictures = {name: torch.stack([blank if c is None else c for c in cells]) for name, cells in columns.items()}
    return contact_sheet(path, pictures, [_short(row.scene) for row in rows], min_cell)


def _heading(rows: Sequence[Row], column: int) -> str:
    names = {row.names[column] for row in rows if column < len(row.names)}
    what = f"input {_short(names.pop())}" if rows[0].source == column and len(names) == 1 else None
    if what is None:
        what = (
            "input" if rows[0].source == column else f"view {_short(names.pop()) if len(names) == 1 else f'({column})'}"
        )
    return what


def _short(name: str, limit: int = 12) -> str:
    return name if len(name) <= limit else name[: limit - 1] + "…"


def _framed(image: Float[Tensor, "3 h w"], size: tuple[int, int], marked: bool) -> Float[Tensor, "3 H W"]:
    """The image within `size` as a whole, on white, with a border, which is coloured where `marked`."""
    scale = min(size[0] / image.shape[1], size[1] / image.shape[2])
    inner = tuple(max(1, min(limit, round(side * scale))) for side, limit in zip(image.shape[1:], size, strict=True))
    if inner != tuple(image.shape[1:]):
        image = interpolate(image[None], inner, mode="area" if scale < 1 else "nearest")[0]
    rows, columns = size[0] - inner[0], size[1] - inner[1]
    image = pad(image, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2), value=1.0)
    width = max(1, size[0] // 50)
    framed = pad(image, (width,) * 4, value=1.0)
    if marked:
        edge = torch.ones(framed.shape[1:], dtype=torch.bool)
        edge[width:-width, width:-width] = False
        framed[:, edge] = torch.tensor(FRAME)[:, None]
    return framed
