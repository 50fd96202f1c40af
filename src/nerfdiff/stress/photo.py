"""What happens to a photograph before its object is cut out: the corruptions of ImageNet-C (Hendrycks and Dietterich,
2019), with its severities. White around the object stays white where a corruption is one of the object's colours."""

import io
from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from PIL import Image
from scipy.ndimage import binary_fill_holes
from torch import Tensor

Picture = Float[Tensor, "3 height width"]
WHITE = 0.95
"""Level from which on all three colours of a pixel together count as white, as for pictures."""


def object_mask(image: Picture) -> Bool[Tensor, "height width"]:
    """Return where the object is: all but the white that is connected to the border."""
    ink = (image < WHITE).any(0).cpu().numpy()
    return torch.from_numpy(binary_fill_holes(ink)).to(image.device)


def _of_object(image: Picture, change: Callable[[Picture], Picture]) -> Picture:
    return torch.where(object_mask(image), change(image).clamp(0, 1), image)


def noise(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Add Gaussian noise of this standard deviation to the object."""
    added = severity * torch.randn(image.shape, generator=draws)
    return _of_object(image, lambda pixels: pixels + added.to(image))


def defocus(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Blur by a disc whose radius is this share of the image's width."""
    radius = severity * image.shape[-1]
    reach = int(np.ceil(radius)) + 1
    axis = torch.arange(-reach, reach + 1, dtype=torch.float32)
    # with a rim one pixel wide: a radius of 0 is no blur
    disc = (radius + 1 - (axis[:, None] ** 2 + axis**2).sqrt()).clamp(0, 1)
    kernel = (disc / disc.sum()).expand(3, 1, -1, -1).to(image)
    padded = F.pad(image[None], [reach] * 4, mode="replicate")
    return F.conv2d(padded, kernel, groups=3)[0]


def jpeg(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Compress as JPEG of this quality."""
    file = io.BytesIO()
    pixels = (image * 255).round().byte().movedim(0, -1).cpu().numpy()
    Image.fromarray(pixels).save(file, "JPEG", quality=round(severity))
    return torch.from_numpy(np.array(Image.open(file))).movedim(-1, 0).to(image) / 255


def contrast(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Multiply the object's distance from its mean colour."""
    mask = object_mask(image)
    if not mask.any():
        return image
    mean = image[:, mask].mean(1)[:, None, None]
    return _of_object(image, lambda pixels: mean + severity * (pixels - mean))


def brightness(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Add to the object's value, in the sense of HSV: its brightest colour; hue and saturation stay."""

    def change(pixels: Picture) -> Picture:
        value = pixels.amax(0, keepdim=True)
        brighter = (value + severity).clamp(0, 1)
        return torch.where(value > 0, pixels * brighter / value.clamp_min(1e-6), brighter.expand_as(pixels))

    return _of_object(image, change)


def low_resolution(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Reduce to this share of the resolution and enlarge again."""
    small = [max(1, round(severity * side)) for side in image.shape[-2:]]
    reduced = F.interpolate(image[None], small, mode="area")
    return F.interpolate(reduced, image.shape[-2:], mode="bilinear", align_corners=False)[0]


def occlusion(image: Picture, severity: float, draws: torch.Generator, patches: int, grey: float) -> Picture:
    """Cover this share of the object's pixels by square patches (RANRAC, arXiv 2312.09780).

    Args:
        patches: how many, around pixels of the object drawn at random.
        grey: level of their colour.
    """
    pixels = object_mask(image).nonzero()
    count = round(severity * len(pixels))
    if count == 0:
        return image
    centres = pixels[torch.randperm(len(pixels), generator=draws)[:patches].to(pixels.device)]
    far = (pixels[:, None] - centres).abs().amax(-1).amin(-1)  # squares are circles of this distance
    rows, columns = pixels[far.argsort(stable=True)[:count]].T
    covered = image.clone()
    covered[:, rows, columns] = grey
    return covered
