"""Inputs that are out of the training images' range are brought within; others are left as they are."""

import numpy as np
import pytest
import torch
from PIL import Image
from striped import picture, scene

import nerfdiff
from nerfdiff.cli import load_config
from nerfdiff.inputs import ASSETS
from nerfdiff.stability.facts import facts, of_picture
from nerfdiff.stability.familiar import Familiar
from nerfdiff.stability.mend import Mend, mend_of, sharpened
from nerfdiff.stress import cutout, framing, photo
from nerfdiff.stress.photo import object_mask

DRAWS = torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def mend() -> Mend:
    known = torch.cat([facts(scene(picture(number))) for number in range(200)])
    features = torch.randn(200, 4, generator=torch.Generator().manual_seed(0))
    return Mend(Familiar.of(features, 2, known), 0.2, 4, [0.25, 0.5, 1.0, 2.0, 4.0])


def error(image: torch.Tensor, truth: torch.Tensor) -> float:
    return float((image - truth).square().mean())


def test_an_input_like_the_training_images_is_the_same_object(mend):
    kept = [scene(picture(number)) for number in range(1000, 1020)]
    assert sum(mend(each) is each for each in kept) >= 19


@pytest.mark.parametrize(
    ("change", "most"),
    [
        (lambda image: cutout.mask_size(image, 1, DRAWS, 0.4), 0.01),
        (lambda image: cutout.mask_size(image, 2, DRAWS, 0.4), 0.01),
        (lambda image: cutout.halo(image, 1, DRAWS, 0.4), 0.01),
        (lambda image: cutout.halo(image, 3, DRAWS, 0.4), 0.45),
    ],
)
def test_what_a_mask_left_in_is_peeled_off(mend, change, most, caplog):
    """The error against the true cut-out falls to a share of what it was."""
    shares = []
    for number in range(1000, 1010):
        true = picture(number)
        broken = change(true)
        after = mend(scene(broken)).source[0]
        shares.append(error(after, true) / error(broken, true))
    assert float(np.median(shares)) <= most
    assert "of the object's edge" in caplog.text and "mend_input=false" in caplog.text


def test_a_soft_picture_is_sharpened_towards_the_true_one(mend):
    usual, better = mend.familiar.usual_value("sharpness"), 0
    for number in range(1000, 1010):
        true = picture(number)
        soft, inside = photo.low_resolution(true, 0.6, DRAWS), object_mask(true)
        before, strength, done = mend.picture(soft)
        assert strength > 0 and any("sharpened" in words for words in done), done
        after = sharpened(before, strength)
        assert abs(of_picture(after)["sharpness"] - usual) < abs(of_picture(soft)["sharpness"] - usual)
        better += error(after[:, inside], true[:, inside]) < error(soft[:, inside], true[:, inside])
    assert better >= 8


def test_the_judge_sees_a_soft_picture_as_it_was_and_a_peeled_one_as_it_is(mend):
    """Sharpened pictures stay out of range for the judge; peeled ones are within."""
    for number in range(1000, 1010):
        soft = mend(scene(photo.low_resolution(picture(number), 0.6, DRAWS)))
        peeled = mend(scene(cutout.mask_size(picture(number), 1, DRAWS, 0.4)))
        assert peeled.soft_pixels is None and not torch.equal(soft.soft_pixels, soft.source_pixels)
        found = mend.familiar.picture_beyond(soft.soft_pixels[0].float() / 255)["sharpness"]
        assert found > 0.2 > mend.familiar.picture_beyond(peeled.source[0])["sharpness"]


@pytest.mark.parametrize(
    "change",
    [
        lambda image: photo.contrast(image, 0.5, DRAWS),
        lambda image: framing.off_centre(image, 6 / 48, DRAWS),  # whole pixels: nothing is softened
        lambda image: photo.brightness(image, 0.1, DRAWS),
        lambda image: photo.noise(image, 0.2, DRAWS),
    ],
)
def test_levels_place_and_noise_stay_as_they_are_given(mend, change):
    """Levels and place may be true. Softening a noisy picture costs more than its noise."""
    kept = [change(picture(number)) for number in range(1000, 1010)]
    assert sum(torch.equal(mend.picture(image)[0], image) for image in kept) >= 8


def test_a_picture_of_nothing_stays(mend):
    assert mend.picture(torch.ones(3, 32, 32))[1:] == (0.0, [])


def test_without_ranges_or_wish_there_is_none(mend):
    asked, not_asked = (load_config("distill", ["ckpt=demo", f"mend_input={word}"]) for word in ("true", "false"))
    assert mend_of(asked, mend.familiar) is not None
    assert mend_of(not_asked, mend.familiar) is None and mend_of(asked, None) is None


def test_a_picture_for_the_shipped_model_is_mended_and_the_log_says_so(tmp_path, caplog):
    model = nerfdiff.load("demo", device="cpu")
    wagon = model.prepare(load_config("picture", ["elevation=20"]), ASSETS / "pictures" / "wagon.png")[1].source[0]
    assert "mended" not in caplog.text
    too_large = cutout.mask_size(wagon, 1, DRAWS, 0.4)
    Image.fromarray((too_large * 255).byte().movedim(0, -1).numpy()).save(tmp_path / "wagon.png")
    found = {}
    for word in ("true", "false"):
        cfg = load_config("picture", ["elevation=20", "picture.object_share=null", f"mend_input={word}"])
        found[word] = model.prepare(cfg, tmp_path / "wagon.png")[1].source[0]
    assert "the input of wagon was mended: 1 pixel of the object's edge was removed" in caplog.text
    assert error(found["true"], wagon) < error(found["false"], wagon) / 10
