import math

import numpy as np
import pytest
import torch

from model_fixtures import input_cameras
from nerfdiff.field.pixel_features import PixelFeatures

HEIGHT, WIDTH, NEAR, FAR = 6, 10, 0.8, 1.8


def features(*maps: torch.Tensor) -> PixelFeatures:
    batch = maps[0].shape[0]
    return PixelFeatures(
        maps, input_cameras(batch, HEIGHT, WIDTH), torch.full((batch,), NEAR), torch.full((batch,), FAR)
    )


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def looked_up(image: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    """By hand: the pinhole's pixel, then four neighbours of which those outside are the border's, in float64."""
    K = input_cameras(1, HEIGHT, WIDTH).K[0].double().numpy()
    _, rows, columns = image.shape
    u = (K[0, 0] * x / z + K[0, 2]) * columns / WIDTH - 0.5
    v = (K[1, 1] * y / z + K[1, 2]) * rows / HEIGHT - 0.5
    u, v = min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
    left, top = math.floor(u), math.floor(v)
    total = np.zeros(len(image))
    for row, weight in ((top, top + 1 - v), (top + 1, v - top)):
        for column, share in ((left, left + 1 - u), (left + 1, u - left)):
            total += weight * share * image[:, min(row, rows - 1), min(column, columns - 1)]
    return total


def points(n: int, spread: float) -> torch.Tensor:
    """Some of them outside the image."""
    made = spread * noise(2, n, 3, seed=1)
    made[..., 2] = NEAR + (FAR - NEAR) * torch.rand(2, n, generator=torch.Generator().manual_seed(2))
    return made


def test_features_are_those_of_the_pixel_that_a_point_projects_to():
    maps, where = (noise(2, 5, 3, 7), noise(2, 3, HEIGHT, WIDTH)), points(200, 0.7)
    found, valid = features(*maps).sample(where)
    assert valid.all() and found.shape == (2, 200, 8)
    for scene in range(2):
        for point, value in zip(where[scene].double().tolist(), found[scene], strict=True):
            expected = np.concatenate([looked_up(one[scene].double().numpy(), *point) for one in maps])
            np.testing.assert_allclose(value.numpy(), expected, atol=2e-5)


@pytest.mark.parametrize(("column", "row"), [(0, 0), (9, 0), (0, 5), (3, 4)])
def test_a_map_of_the_images_size_is_the_image_pixel_for_pixel(column, row):
    image, K = noise(1, 3, HEIGHT, WIDTH), input_cameras(1, HEIGHT, WIDTH).K[0]
    ray = torch.tensor([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0])
    found, _ = features(image).sample(torch.stack([0.9 * ray, 1.7 * ray])[None])
    for depth in range(2):  # the same all along the ray
        torch.testing.assert_close(found[0, depth], image[0, :, row, column], atol=1e-5, rtol=0)


def test_what_lies_before_the_near_plane_is_not_valid():
    _, valid = features(noise(1, 2, 4, 4)).sample(torch.tensor([[[0.0, 0.0, z] for z in (-1.0, 0.0, 0.79, 0.81, 5.0)]]))
    assert valid[0].tolist() == [False, False, False, True, True]


def test_positions_are_relative_to_the_frustum_whatever_the_units():
    where = points(4, 0.3)
    unit = features(noise(2, 1, 4, 4))
    found = unit.centred(where)
    np.testing.assert_allclose(found.numpy(), where.numpy() - [0, 0, 1.3], atol=1e-6)  # FAR - NEAR is 1
    tenfold = PixelFeatures(unit.maps, unit.cameras, 10 * unit.near, 10 * unit.far)
    torch.testing.assert_close(tenfold.centred(10 * where), found)
