"""What goes wrong where the object is cut out of its background: its mask, its edge, its shadow."""

import numpy as np
import torch
from jaxtyping import Bool
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt
from torch import Tensor

from nerfdiff.stress.photo import Picture, object_mask

SQUARE = np.ones((3, 3), bool)
"""Neighbours by sides and by corners: one step of it moves a mask's border by one pixel everywhere."""


def grown(mask: Bool[Tensor, "height width"], pixels: int) -> Bool[Tensor, "height width"]:
    """Dilate a mask by so many pixels, or erode it where they are negative."""
    if pixels == 0:
        return mask
    change = binary_dilation if pixels > 0 else binary_erosion
    # beyond the frame is what is within: an object that the frame cuts is not eroded there
    border = 0 if pixels > 0 else 1
    moved = change(mask.cpu().numpy(), SQUARE, iterations=abs(pixels), border_value=border)
    return torch.from_numpy(moved).to(mask.device)


def mask_size(image: Picture, severity: float, draws: torch.Generator, background: float) -> Picture:
    """Cut the object out by a mask that is so many pixels too large, or, negative, too small.

    Args:
        background: grey level of what lay behind the object, which a mask that is too large leaves in.
    """
    mask = object_mask(image)
    kept = grown(mask, round(severity))
    return torch.where(mask, image, background).where(kept, torch.ones_like(image))


def halo(image: Picture, severity: float, draws: torch.Generator, background: float) -> Picture:
    """Leave so many pixels of the background around the object, fading out to white."""
    mask = object_mask(image)
    distance = torch.from_numpy(distance_transform_edt(~mask.cpu().numpy())).to(image)
    share = (1 - distance / (severity + 1)).clamp(0, 1) if mask.any() else torch.zeros_like(distance)
    return torch.where(mask, image, 1 - share * (1 - background))


def shadow(image: Picture, severity: float, draws: torch.Generator, height: float, width: float) -> Picture:
    """Leave the contact shadow in: an ellipse under the object, of this darkness in its middle.

    Args:
        height, width: of the ellipse, as shares of the object's own width.
    """
    mask = object_mask(image)
    if not mask.any():
        return image
    rows, columns = (mask.any(axis).nonzero()[:, 0] for axis in (1, 0))
    wide = float(columns[-1] - columns[0] + 1)
    y, x = (torch.arange(size, device=image.device) + 0.5 for size in mask.shape)
    down = (y - float(rows[-1] + 1)) / (height * wide / 2)
    across = (x - float(columns[0] + columns[-1] + 1) / 2) / (width * wide / 2)
    dark = severity * (1 - (down[:, None] ** 2 + across**2)).clamp(0, 1)
    return torch.where(mask, image, image * (1 - dark))


def white_object(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Blend the object's colours with white: a white object on white."""
    return image + severity * (1 - image)
