"""Pictures of a made-up dataset: striped ellipses on white."""

from dataclasses import replace

import torch

from model_fixtures import input_cameras
from nerfdiff.data.batch import ViewBatch

SIZE = 48


def picture(number: int) -> torch.Tensor:
    """A striped ellipse on white, of its own colours, size and place."""
    draws = torch.Generator().manual_seed(number)
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    wide, high, right, down, turn = (torch.rand(5, generator=draws) * torch.tensor([3, 3, 3, 3, 6.0])).tolist()
    where = ((x - 22.5 - right) / (12 + wide)) ** 2 + ((y - 22.5 - down) / (8 + high)) ** 2 < 1
    stripes = ((x * 0.9 + y * 0.5 + turn) % 6 < 3) | (y % 7 < 2)
    light, dark = torch.rand(2, 3, generator=draws) * torch.tensor([[0.25], [0.2]]) + torch.tensor([[0.6], [0.1]])
    image = torch.where(stripes, light[:, None, None], dark[:, None, None])
    return torch.where(where, image, torch.ones(()))


def scene(image: torch.Tensor) -> ViewBatch:
    pixels = (image * 255).round().byte()[None]
    camera = input_cameras(1, SIZE, SIZE)
    target = replace(camera, c2w=camera.c2w[:, None], K=camera.K[:, None])
    bounds = torch.tensor([0.8]), torch.tensor([1.8])
    return ViewBatch(torch.tensor([0]), pixels, camera, pixels[:, None], target, *bounds, ("a",), ("0",), (("0",),))
