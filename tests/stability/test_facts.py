"""Facts of inputs: closed forms, and faults that push the right one out of its range."""

from dataclasses import replace

import pytest
import torch

from model_fixtures import input_cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.stability.facts import FACTS, excess, facts, names_of, usual_range
from nerfdiff.stress import cameras, cutout, framing, photo

SIZE = 48


def scene(image: torch.Tensor) -> ViewBatch:
    pixels = (image * 255).round().byte()[None]
    camera = input_cameras(1, SIZE, SIZE)
    nothing = replace(camera, c2w=camera.c2w[:, None], K=camera.K[:, None])
    bounds = torch.tensor([0.8]), torch.tensor([1.8])
    return ViewBatch(torch.tensor([0]), pixels, camera, pixels[:, None], nothing, *bounds, ("a",), ("0",), (("0",),))


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


@pytest.fixture(scope="module")
def usual() -> torch.Tensor:
    return usual_range(torch.cat([facts(scene(picture(number))) for number in range(200)]))


def beyond(changed: ViewBatch, usual: torch.Tensor) -> dict[str, float]:
    return names_of(excess(facts(changed)[0], usual))


def test_a_grey_box_has_the_facts_that_are_counted_by_hand():
    image = torch.ones(3, SIZE, SIZE)
    image[:, 10:22, 6:30] = 0.25  # 12 rows, 24 columns
    found = dict(zip(FACTS, facts(scene(image))[0].tolist(), strict=True))
    expected = {
        "near": 0.8, "far": 1.8, "size": (12 * 24 / SIZE**2) ** 0.5, "share": 24 / SIZE, "margin": 6 / SIZE,
        "across": (6 - 18) / SIZE, "along": (10 - 26) / SIZE, "background": 0, "contrast": 0,
        "darkest": 64 / 255, "lightest": 64 / 255,
    }  # fmt: skip
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    assert found["focal"] == pytest.approx(float(input_cameras(1, SIZE, SIZE).K[0, 0, 0]) / SIZE)
    assert found["edge"] == found["second_edge"] == pytest.approx(torch.log(torch.tensor(1e-3)).item())


def test_how_far_beyond_is_counted_in_widths_of_the_range():
    usual = torch.tensor([[1.0, 2.0, 3.0]] * len(FACTS))
    found = torch.full((len(FACTS),), 2.0)
    found[:3] = torch.tensor([4.0, 0.5, float("nan")])
    named = names_of(excess(found, usual))
    assert (named.pop("focal"), named.pop("near")) == (0.5, 0.25) and "far" not in named
    assert set(named.values()) == {0.0}


def test_images_like_the_training_images_are_in_range(usual):
    far = [max(beyond(scene(picture(number)), usual).values()) for number in range(1000, 1060)]
    assert sum(each > 0.2 for each in far) <= 3


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda image, draws: cutout.mask_size(image, 1, draws, 0.4), "edge"),
        (lambda image, draws: cutout.mask_size(image, 2, draws, 0.4), "second_edge"),
        (lambda image, draws: cutout.halo(image, 2, draws, 0.4), "edge"),
        (lambda image, draws: photo.defocus(image, 0.03, draws), "sharpness"),
        (lambda image, draws: photo.low_resolution(image, 0.5, draws), "sharpness"),
        (lambda image, draws: photo.noise(image, 0.3, draws), "sharpness"),
        (lambda image, draws: photo.contrast(image, 0.1, draws), "contrast"),
        (lambda image, draws: photo.jpeg(image, 10, draws), "background"),
        (lambda image, draws: cutout.white_object(image, 0.6, draws), "darkest"),
        (lambda image, draws: photo.brightness(image, 0.6, draws), "lightest"),
        (lambda image, draws: framing.object_size(image, 0.5, draws), "size"),
        (lambda image, draws: framing.object_size(image, 1.7, draws), "margin"),
        (lambda image, draws: framing.off_centre(image, 0.2, draws), "across"),
        (lambda image, draws: framing.off_centre(image, 0.2, draws), "along"),
        (lambda image, draws: framing.cut_off(image, 0.1, draws), "margin"),
    ],
)
def test_each_fault_of_a_picture_pushes_its_fact_out_of_range(usual, change, expected):
    draws = torch.Generator().manual_seed(0)
    told = [beyond(scene(change(picture(n), draws).clamp(0, 1)), usual)[expected] > 0.2 for n in range(1000, 1012)]
    assert sum(told) >= 10


@pytest.mark.parametrize("factor", [0.85, 1.2])
def test_another_lens_and_another_unit_of_length_are_told(usual, factor):
    sound = scene(picture(1000))
    assert {"focal"} == {name for name, far in beyond(cameras.focal(sound, factor), usual).items() if far > 0.2}
    assert {"near", "far"} == {
        name for name, far in beyond(cameras.near_far(sound, factor), usual).items() if far > 0.2
    }


def test_a_picture_of_nothing_is_no_error_and_too_small(usual):
    found = beyond(scene(torch.ones(3, SIZE, SIZE)), usual)
    assert found["size"] > 0.2 and "edge" not in found
