"""Plain facts of an input, of its picture and its camera: those of a failure are out of the training images' range.

No network is asked. A network's features tell other objects; these tell other cut-outs, frames, lenses and blurs.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.stress.cutout import grown
from nerfdiff.stress.photo import Picture, object_mask

FACTS = {
    "focal": "the focal length is another than that of the training cameras",
    "near": "the near bound is another than that of the training scenes",
    "far": "the far bound is another than that of the training scenes",
    "size": "the object is larger or smaller in its frame than the training images'",
    "share": "the object fills more or less of its frame's height or width than in the training images",
    "margin": "the object is nearer to the frame's edge than the training images', or cut off by it",
    "across": "the object stands further left or right than the training images'",
    "along": "the object stands higher or lower than the training images'",
    "background": "the background is not as white as the training images'",
    "edge": "the object's outermost pixels are too even, or too uneven: a mask that is too large, or a halo",
    "second_edge": "the pixels behind the object's outermost are too even, or too uneven: a mask that is too large",
    "sharpness": "the picture is softer or sharper than the training images",
    "steepness": "the picture has fewer or more steep edges than the training images: noise, or blur",
    "contrast": "the object's colours vary less or more than those of the training images",
    "darkest": "the object's darkest parts are lighter or darker than those of the training images",
    "lightest": "the object's lightest parts are lighter or darker than those of the training images",
    "grain": "the object's surface is smoother or grainier than those of the training images",
}
"""What each fact says where it is out of the training images' range."""
USUAL = 0.01
"""Share of training images that each end of a range leaves out."""
LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601
LEAST_WIDTH = 0.02
"""Width of a range at least, as a share of its middle: a dataset of one lens has a range of none."""


def facts(scene: ViewBatch) -> Float[Tensor, "batch facts"]:
    """Measure the inputs of scenes, in the order of `FACTS`; NaN where there is too little of an object to measure."""
    focal = scene.source_cameras.K[:, 1, 1] / scene.source_cameras.height
    cameras = torch.stack([focal, scene.near, scene.far], 1)
    pictures = torch.stack([torch.tensor(_of_picture(image)) for image in scene.source.cpu()])
    return torch.cat([cameras.cpu().float(), pictures.float()], 1)


def usual_range(found: Float[Tensor, "images facts"]) -> Float[Tensor, "facts 3"]:
    """Return the ends between which all but a few of the training images' facts lie, around their median."""
    quantiles = torch.tensor([USUAL, 0.5, 1 - USUAL], dtype=torch.float64)
    low, middle, high = torch.nanquantile(found.double(), quantiles, dim=0)
    missing = (LEAST_WIDTH * middle.abs() - (high - low)).clamp_min(0) / 2
    return torch.stack([low - missing, middle, high + missing], 1).float()


def excess(found: Float[Tensor, "facts"], usual: Float[Tensor, "facts 3"]) -> Float[Tensor, "facts"]:
    """Return how far each fact lies beyond its range, in widths of the range; 0 within."""
    low, _, high = usual.unbind(1)
    beyond = torch.maximum(low - found, found - high).clamp_min(0)
    return beyond / (high - low).clamp_min(1e-6)


def _of_picture(image: Picture) -> list[float]:
    """Facts of a picture on white, from `size` on."""
    mask = object_mask(image)
    if not mask.any():
        return [0.0] + [float("nan")] * (len(FACTS) - 4)
    height, width = mask.shape
    rows, columns = (mask.any(axis).nonzero()[:, 0] for axis in (1, 0))
    top, left = int(rows[0]), int(columns[0])
    bottom, right = height - 1 - int(rows[-1]), width - 1 - int(columns[-1])
    light = (image * torch.tensor(LUMINANCE)[:, None, None]).sum(0)
    once, twice = grown(mask, -1), grown(mask, -2)
    steps = torch.cat([image.diff(dim=axis).abs().sum(0).flatten() for axis in (1, 2)])
    grains = _laplacian(light)[twice[1:-1, 1:-1]].abs()
    return [
        float(mask.float().mean().sqrt()),
        max(1 - (top + bottom) / height, 1 - (left + right) / width),
        min(top / height, bottom / height, left / width, right / width),
        (left - right) / width,
        (top - bottom) / height,
        float((1 - image[:, ~mask]).mean()) if (~mask).any() else 0.0,
        _variation(image, mask & ~once),
        _variation(image, once & ~twice),
        float(torch.log(_rms(_laplacian(image)) / _rms(_laplacian(F.avg_pool2d(image[None], 2)[0])))),
        float(torch.log(torch.quantile(steps, 0.995) / (torch.quantile(steps, 0.9) + 0.02) + 1e-3)),
        float(light[mask].std(correction=0)),
        float(torch.quantile(light[mask], 0.02)),
        float(torch.quantile(light[mask], 0.98)),
        float(torch.log(grains.median() + 1e-3)) if grains.numel() else float("nan"),
    ]


def _variation(image: Picture, where: Bool[Tensor, "height width"]) -> float:
    """Return the logarithm of the colours' standard deviation."""
    return float(torch.log(image[:, where].std(1).mean() + 1e-3)) if where.sum() > 4 else float("nan")


def _laplacian(image: Float[Tensor, "*c height width"]) -> Float[Tensor, "*c h w"]:
    across = image[..., 1:-1, :-2] + image[..., 1:-1, 2:]
    return 4 * image[..., 1:-1, 1:-1] - image[..., :-2, 1:-1] - image[..., 2:, 1:-1] - across


def _rms(values: Tensor) -> Tensor:
    return values.square().mean().sqrt() + 1e-4


def names_of(beyond: Float[Tensor, "facts"], names: Sequence[str] = tuple(FACTS)) -> dict[str, float]:
    """Name how far each fact lies beyond its range; those that could not be measured are left out."""
    return {name: float(value) for name, value in zip(names, beyond, strict=True) if value == value}
