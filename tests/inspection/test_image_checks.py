"""Blank and repeated images, and masks that cannot be those of objects, each limit from both sides."""

from dataclasses import replace

import pytest
import torch
from solids import solid_scene

from nerfdiff.inspection.check import Status
from nerfdiff.inspection.image_checks import Images, Masks

IMAGES = Images(contrast=0.02, max_share=0.1, tolerated=0)
MASKS = Masks(max_border=0.5, tolerated=0)
SCENE = solid_scene(views=20, mask=True)


def painted(views: int, value) -> torch.Tensor:
    pixels = SCENE.pixels.clone()
    pixels[:views] = torch.as_tensor(value, dtype=torch.uint8)
    return pixels


def test_images_that_show_something_pass():
    assert IMAGES(SCENE).status is Status.OK and IMAGES(SCENE).value == 0


@pytest.mark.parametrize("colour", [255, 0, 90])
def test_blank_images_fail(colour):
    finding = IMAGES(replace(SCENE, pixels=painted(20, colour)))
    assert finding.status is Status.FAILED and finding.value == 1
    assert finding.reason.startswith("20 of 20 images are blank: 000000, 000001") and "another" not in finding.reason
    assert IMAGES(replace(SCENE, pixels=painted(2, colour))).status is Status.OK
    few = IMAGES(replace(SCENE, pixels=painted(3, colour)))
    assert few.reason == "3 of 20 images are blank: 000000, 000001, 000002" and few.value == 0.15


def test_a_plain_colour_is_blank_and_noise_of_a_sensor_does_not_hide_it():
    plain = torch.tensor([200, 30, 60])[:, None, None].expand(3, *SCENE.pixels.shape[2:])
    assert IMAGES(replace(SCENE, pixels=painted(20, plain))).value == 1
    noisy = plain + torch.randint(0, 4, plain.shape, generator=torch.Generator().manual_seed(0))
    assert IMAGES(replace(SCENE, pixels=painted(20, noisy))).value == 1


def test_images_of_other_poses_that_are_the_same_fail():
    same = replace(SCENE, pixels=painted(20, SCENE.pixels[0]))
    finding = IMAGES(same)
    assert finding.status is Status.FAILED and finding.value == 0.95
    assert "19 of 20 images are those of another view, whose pose is another: 000001" in finding.reason
    still = replace(same, cameras=SCENE.cameras[[0] * 20])  # a video of a camera that stands
    assert IMAGES(still).status is Status.OK
    assert IMAGES(replace(SCENE, pixels=painted(3, SCENE.pixels[0]))).status is Status.OK  # two are repeated


def test_masks_of_objects_pass_and_measure_their_share():
    finding = MASKS(SCENE)
    assert finding.status is Status.OK and finding.value == pytest.approx(SCENE.mask.double().mean().item())
    assert MASKS(replace(SCENE, mask=None)).status is Status.UNCHECKED
    some_empty = SCENE.mask.clone()
    some_empty[:19] = False
    assert MASKS(replace(SCENE, mask=some_empty)).status is Status.OK


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (torch.logical_not, "border in 20 of 20 views; they look inverted"),
        (torch.zeros_like, "empty in every view"),
        (torch.ones_like, "cover all of every view"),
    ],
)
def test_misread_masks_fail(change, words):
    finding = MASKS(replace(SCENE, mask=change(SCENE.mask)))
    assert finding.status is Status.FAILED and words in finding.reason
