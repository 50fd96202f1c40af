"""Pictures for people: contact sheets, coloured depth and orbit videos."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfdiff.metrics.image import quantise
from nerfdiff.utils.files import atomic

INK, PAPER = (30, 30, 30), (255, 255, 255)


@cache
def _colours(name: str) -> Float[Tensor, "256 3"]:
    from kornia.color import ColorMap

    return ColorMap(name, num_colors=256, dtype=torch.float32).colors.T


def colour_depth(
    depth: Float[Tensor, "n h w"],
    near: float,
    far: float,
    opacity: Float[Tensor, "n h w"] | None = None,
    colormap: str = "turbo",
) -> Float[Tensor, "n 3 h w"]:
    """Depth as colours, from the map's far end at `near` to its other end at `far`, over white by `opacity`.

    Args:
        colormap: a name kornia knows.
    """
    nearness = ((far - depth.float().cpu()) / (far - near)).nan_to_num(0).clamp(0, 1)
    colours = _colours(colormap)[(nearness * 255).round().long()].permute(0, 3, 1, 2)
    if opacity is None:
        return colours
    alpha = opacity.float().cpu().clamp(0, 1)[:, None]
    return colours * alpha + 1 - alpha


def contact_sheet(
    path: str | Path,
    columns: Mapping[str, Float[Tensor, "rows 3 h w"] | None],
    row_names: Sequence[str] | None = None,
    min_cell: int = 128,
    gap: int = 4,
) -> Path:
    """Save a PNG with one row per scene and one headed column per kind of picture.

    Args:
        columns: pictures in [0, 1] under their headings; a column that is None is left out.
        row_names: written to the left of the rows.
        min_cell: smaller pictures are enlarged by a whole factor (pixels stay squares) to this height or more.
        gap: white pixels between pictures.

    Raises:
        DataError: the file cannot be written.
    """
    pixels = {name: quantise(images).cpu() for name, images in columns.items() if images is not None}
    if not pixels or len({images.shape for images in pixels.values()}) != 1:
        shapes = {name: tuple(images.shape) for name, images in pixels.items()}
        raise ValueError(f"columns of a contact sheet must have one shape, got {shapes}")
    rows, _, h, w = next(iter(pixels.values())).shape
    factor = math.ceil(min_cell / h)
    height, width = h * factor, w * factor
    text = max(12, height // 10)
    font = ImageFont.load_default(size=text)
    names = list(row_names or [])
    left = max((math.ceil(font.getlength(name)) for name in names), default=-gap) + 2 * gap
    wide = max(width, *(math.ceil(font.getlength(heading)) for heading in pixels))
    top = text + 3 * gap
    sheet = Image.new("RGB", (left + len(pixels) * (wide + gap), top + rows * (height + gap)), PAPER)
    draw = ImageDraw.Draw(sheet)
    for column, (heading, images) in enumerate(pixels.items()):
        x = left + column * (wide + gap)
        draw.text((x + wide / 2, top / 2), heading, INK, font, anchor="mm")
        for row, image in enumerate(_enlarged(images, factor)):
            sheet.paste(Image.fromarray(image), (x + (wide - width) // 2, top + row * (height + gap)))
    for row, name in enumerate(names):
        draw.text((left - gap, top + row * (height + gap) + height / 2), name, INK, font, anchor="rm")
    path = Path(path)
    with atomic(path) as temporary:
        sheet.save(temporary)
    return path


def labelled_sheet(
    path: str | Path, cells: Mapping[str, Float[Tensor, "3 h w"]], across: int = 2, factor: int = 4, gap: int = 8
) -> Path:
    """Save a PNG of pictures in [0, 1] under their labels, enlarged by a whole factor, so many in a line.

    Raises:
        DataError: the file cannot be written.
    """
    pixels = _enlarged(quantise(torch.stack(list(cells.values()))).cpu(), factor)
    height, width = pixels.shape[1:3]
    font = ImageFont.load_default(size=max(12, height // 16))
    text = 2 * max(12, height // 16)
    width = max(width, *(math.ceil(font.getlength(label)) for label in cells))
    lines = math.ceil(len(cells) / across)
    sheet = Image.new("RGB", (across * (width + gap), lines * (height + text + gap)), PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, (label, image) in enumerate(zip(cells, pixels, strict=True)):
        x, y = number % across * (width + gap), number // across * (height + text + gap)
        draw.text((x, y + text / 2), label, INK, font, anchor="lm")
        sheet.paste(Image.fromarray(image), (x, y + text))
    path = Path(path)
    with atomic(path) as temporary:
        sheet.save(temporary)
    return path


def orbit_video(path: str | Path, frames: Float[Tensor, "n 3 h w"], fps: int | float = 25, min_size: int = 256) -> Path:
    """Save frames in [0, 1] as an H.264 mp4 that any player shows (yuv420p).

    Frames smaller than `min_size` pixels are enlarged by a whole factor (pixels stay squares); a last odd row
    or column is repeated, as the format needs even sizes.

    Raises:
        DataError: the file cannot be written.
    """
    pixels = quantise(frames).cpu()
    images = _enlarged(pixels, math.ceil(min_size / min(pixels.shape[-2:])))
    images = np.pad(images, ((0, 0), (0, images.shape[1] % 2), (0, images.shape[2] % 2), (0, 0)), mode="edge")
    path = Path(path)
    with atomic(path) as temporary:
        # Sizes are even already; a larger macro block would have ffmpeg resample every frame.
        imageio.mimwrite(temporary, list(images), fps=fps, codec="libx264", pixelformat="yuv420p", macro_block_size=2)
    return path


def _enlarged(images: UInt8[Tensor, "n 3 h w"], factor: int) -> UInt8[np.ndarray, "n H W 3"]:
    large = images.repeat_interleave(factor, dim=-2).repeat_interleave(factor, dim=-1)
    return large.permute(0, 2, 3, 1).contiguous().numpy()
