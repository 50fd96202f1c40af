"""How the object lies in the frame. What comes into the frame is white."""

import torch

from nerfdiff.data.picture import area_resample
from nerfdiff.stress.photo import Picture, object_mask


def _window(image: Picture, top: float, left: float, zoom: float = 1.0) -> Picture:
    """Resample the part of the image whose top left corner is given in pixels, 1/zoom times the frame's size."""
    height, width = image.shape[-2:]
    pixels = (image * 255).round().byte().movedim(0, -1).cpu().numpy()
    framed = area_resample(pixels, (top, left, height / zoom, width / zoom), (height, width))
    return torch.from_numpy(framed).movedim(-1, 0).to(image) / 255


def object_size(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Show the object so many times as large, around the frame's centre; what leaves the frame is cut off."""
    height, width = image.shape[-2:]
    return _window(image, height * (1 - 1 / severity) / 2, width * (1 - 1 / severity) / 2, severity)


def off_centre(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Move the object to the right and down by this share of the frame."""
    height, width = image.shape[-2:]
    return _window(image, -severity * height, -severity * width)


def cut_off(image: Picture, severity: float, draws: torch.Generator) -> Picture:
    """Move the object to the left until the frame has cut off this share of its width."""
    columns = object_mask(image).any(0).nonzero()[:, 0]
    if not len(columns):
        return image
    return _window(image, 0.0, float(columns[0]) + severity * float(columns[-1] + 1 - columns[0]))
