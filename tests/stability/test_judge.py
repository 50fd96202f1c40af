"""The judge on failures that are planted, and its limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from model_fixtures import input_cameras, look_at, model
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.distill.trace import Step
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.stability.facts import facts
from nerfdiff.stability.familiar import Familiar, features
from nerfdiff.stability.judge import ENDS, LEAST, MOST, SIGNS, Judge
from nerfdiff.stability.limits import Sample, fit_limits, halves, limits_text, rates, suspected
from nerfdiff.utils.errors import ConfigError, DataError

SIZE = 16
OLD = {"familiar": '{"rest": 1.0, "usual": 1.0}'}
JUDGE = Judge(views=3, time=0.6, least={"input_psnr": 20.0, "least_coverage": 0.3}, most={"border": 0.2, "unlike": 1.5})


@pytest.fixture(scope="module")
def scene() -> ViewBatch:
    source = input_cameras(1, SIZE, SIZE)
    centres = [(1.3, 0, 1.3), (-1.3, 0.1, 1.3), (0, 0.5, 2.5)]
    c2w = torch.stack([look_at(centre) for centre in centres])[None]
    targets = replace(source, c2w=c2w, K=source.K[None].expand(1, 3, 3, 3))
    pixels = torch.full((1, 3, SIZE, SIZE), 255, dtype=torch.uint8)
    pixels[..., 4:12, 4:12] = torch.randint(40, 160, (3, 8, 8), generator=torch.Generator().manual_seed(0)).byte()
    bounds = torch.tensor([0.8]), torch.tensor([1.8])
    views = pixels[:, None].expand(1, 3, -1, -1, -1)
    return ViewBatch(torch.tensor([0]), pixels, source, views, targets, *bounds, ("a",), ("0",), (("1", "2", "3"),))


@pytest.fixture(scope="module")
def net():
    return model().eval().requires_grad_(False)


@pytest.fixture(scope="module")
def views(scene) -> PredictedViews:
    """Of a cube that shows the same from everywhere."""
    images = scene.source.expand(3, -1, -1, -1)
    return PredictedViews(images, opacity=(images < 0.95).any(1).float(), depth=torch.ones(3, SIZE, SIZE))


def signs(net, scene, views, familiar=None) -> dict[str, float]:
    return JUDGE.signs(net, scene, views, familiar, seed=0)


def test_signs_are_measured_of_every_kind_of_prediction_and_are_the_same_again(net, scene, views):
    found = signs(net, scene, views)
    assert found == signs(net, scene, views) and set(found) <= set(SIGNS)
    assert {"border", "coverage", "haze", "samples", "denoised", "input_psnr", "input_iou"} <= set(found)
    assert found["border"] == 0 and found["coverage"] == pytest.approx(0, abs=1e-5) and found["haze"] == 0
    assert found["flatness"] == pytest.approx(1, rel=1e-4)
    bare = signs(net, scene, PredictedViews(views.images))
    assert "border" not in bare and "moved" not in bare
    traced = signs(net, scene, replace(views, trace=[Step(0.1, 0.5, 1.0, 0.5, 31.0)]))
    assert traced["agreement"] == 31.0 and traced["moved"] > 0


def test_a_field_is_asked_for_the_input_view(net, scene, views):
    """The sign of the input view is of the field that was fitted, not of the model's first."""
    encoding = net.encode(scene)
    field = RefinedField(encoding.triplane, net.decoder)
    first = signs(net, scene, replace(views, field=SavedField(field, net.renderer)))
    assert first["input_psnr"] == pytest.approx(signs(net, scene, views)["input_psnr"], abs=0.05)
    with torch.no_grad():
        field.planes.fill_(0.5)
    other = signs(net, scene, replace(views, field=SavedField(field, net.renderer)))
    assert abs(other["input_psnr"] - first["input_psnr"]) > 0.05


def planted(kind: str, views: PredictedViews) -> PredictedViews:
    opacity = views.opacity.clone()
    if kind == "cut by the frame":
        opacity[0] = 1.0
    elif kind == "an empty view":
        opacity[1] = 0.0
    return replace(views, opacity=opacity)


@pytest.mark.parametrize(
    ("kind", "said"), [("cut by the frame", "reaches the border"), ("an empty view", "all but empty")]
)
def test_planted_failures_are_suspected_and_why_is_said(net, scene, views, kind, said):
    sound = signs(net, scene, views) | {"input_psnr": 30.0}
    assert JUDGE.verdict(sound) == "ok"
    found = signs(net, scene, planted(kind, views)) | {"input_psnr": 30.0}
    assert JUDGE.verdict(found).startswith("suspect: ") and said in JUDGE.verdict(found)


def test_every_sign_has_an_end_at_which_it_is_bad():
    assert set(ENDS) == set(SIGNS) and set().union(*ENDS.values()) == {LEAST, MOST}


def test_a_fallback_a_wrong_input_view_and_a_sign_that_is_not_finite_are_suspected():
    sound = {"input_psnr": 30.0}
    assert JUDGE.verdict(sound, "diverged") == "suspect: it fell back (diverged)"
    assert "another picture (12.0 dB)" in JUDGE.verdict({"input_psnr": 12.0})
    assert JUDGE.verdict({"input_psnr": float("nan")}) != "ok" and JUDGE.verdict({"haze": float("nan")}) == "ok"
    both = JUDGE.verdict({"input_psnr": 12.0, "unlike": 2.0})
    assert both.count(";") == 1
    with pytest.raises(ConfigError, match="beauty is no sign; choose input_psnr"):
        Judge(1, 0.5, {"beauty": 1.0}, {})


def test_an_image_unlike_the_training_images_is_far_from_them(net, scene, tmp_path, caplog):
    path = tmp_path / "familiar.safetensors"
    draws = torch.Generator().manual_seed(0)
    encoded, known = [], []
    for _ in range(48):
        pixels = scene.source_pixels.clone()
        pixels[..., 4:12, 4:12] = torch.randint(40, 160, (3, 8, 8), generator=draws).byte()
        encoded.append(features(net.encode(replace(scene, source_pixels=pixels))))
        known.append(facts(replace(scene, source_pixels=pixels)))
    familiar = Familiar.of(torch.cat(encoded), 8, torch.cat(known))
    assert float(familiar.distance(torch.cat(encoded[1::2])).max()) < 1.3
    familiar.save(path)
    loaded = Familiar.load(path)
    black = replace(scene, source_pixels=torch.zeros_like(scene.source_pixels))
    for known in (familiar, loaded):
        assert float(known.distance(features(net.encode(scene)))[0]) < 1.3
        found = signs(net, black, PredictedViews(black.source.expand(3, -1, -1, -1)), known)
        assert found["unlike"] > 2 and found["size"] > 0.2 and found["near"] == 0
    # of an input that was sharpened, the facts are those of before
    before = replace(scene, soft_pixels=black.source_pixels)
    sizes = [signs(net, each, PredictedViews(scene.targets[0]), familiar)["size"] for each in (scene, before)]
    assert sizes == [0, found["size"]]
    save_file({name: part for name, part in load_file(path).items() if name != "ranges"}, path, OLD)
    assert Familiar.load(path).ranges is None and "make it again" in caplog.text
    path.write_bytes(b"no")
    with pytest.raises(DataError, match=r"familiar\.safetensors: cannot be read"):
        Familiar.load(path)


def samples(count: int, seed: int) -> list[Sample]:
    """Broken scenes have a low first sign or a high second one; the third says nothing."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        broken = number % 3 == 0
        psnr = rng.normal(15 if broken and number % 2 else 30, 1)
        haze = rng.normal(0.8 if broken and not number % 2 else 0.2, 0.05)
        signs = {"input_psnr": psnr, "haze": haze, "samples": rng.normal(30, 1)}
        made.append(Sample(f"axis{number % 5}", f"scene{number % 7}", signs, broken))
    return made


def test_limits_are_those_signs_that_tell_and_few_sound_scenes_are_suspected():
    limits = fit_limits(samples(90, 0), false_alarms=0.05, steps=6, margin=0.5)
    assert set(limits) == {("input_psnr", LEAST), ("haze", MOST)}
    assert rates(limits, samples(90, 1)) == (1.0, 0.0)
    assert suspected(limits, {"input_psnr": float("nan")}) and not suspected(limits, {})
    assert rates({}, samples(30, 0)) == (0.0, 0.0)
    assert fit_limits([replace_broken(s) for s in samples(30, 0)], 0.05, 6, 0.5) == {}


def replace_broken(sample: Sample) -> Sample:
    return replace(sample, broken=False)


def test_false_alarms_stay_within_their_share():
    """A sign that tells the broken from nothing is cut where 5 % of the sound are lost at most."""
    rng = np.random.default_rng(0)
    mixed = [Sample("a", "s", {"haze": rng.normal(0.3 if n % 2 else 0.0, 0.2)}, bool(n % 2)) for n in range(400)]
    recall, alarms = rates(fit_limits(mixed, 0.05, 6, 0.5), mixed)
    assert 0.2 < recall < 0.7 and alarms <= 0.05


def test_the_halves_share_no_axis_and_no_scene():
    one, two = halves([replace(s, axis=f"x{n % 11}", scene=f"s{n % 8}") for n, s in enumerate(samples(200, 0))])
    assert one and two
    assert not {s.axis for s in one} & {s.axis for s in two} and not {s.scene for s in one} & {s.scene for s in two}
    assert "recall" in limits_text({("haze", MOST): 0.5}, one, two) and "  haze: 0.5" in limits_text(
        {("haze", MOST): 0.5}, one, two
    )
