import pytest
import torch
from solid_scene import FAR, NEAR, pictures, ring

from nerfdiff.metrics.consistency import Consistency, evenly

SETTINGS = {
    **{"scenes": None, "views": 50, "steps": 100, "rays": 192, "lr": 4e-2, "seed": 0},
    **{"plane_size": 16, "channels": 8, "hidden": 32, "initial_std": 0.1},
    **{"density_shift": -3.0, "density_scale": 32.0, "uniform_samples": 12, "importance_samples": 12},
    **{"background": 1.0, "chunk": 10**6},
}
CAMERAS = ring(16, size=16, heights=(0.0, -0.3, 0.2, -0.6))


def measure(pixels, cameras=CAMERAS, **changes):
    return Consistency(**(SETTINGS | changes)).measure(pixels, "scene", cameras, ring(1, size=16), NEAR, FAR)


@pytest.fixture(scope="module")
def pixels():
    return pictures(CAMERAS)[0]


@pytest.fixture(scope="module")
def true_psnr(pixels):
    return measure(pixels)


def test_views_of_one_scene_agree(true_psnr):
    assert true_psnr > 20


def test_views_that_are_mirrored_or_belong_to_other_cameras_do_not(pixels, true_psnr):
    mirrored = pixels.clone()
    mirrored[1::2] = mirrored[1::2].flip(-1)
    turned = torch.roll(pixels, 8, 0)
    turned[::2] = pixels[::2]
    for views in (mirrored, turned):
        assert measure(views) < true_psnr - 5


def test_noise_of_its_own_in_every_view_is_not_predicted(pixels, true_psnr):
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0))
    noisy = (pixels.float() + 50 * noise).clamp(0, 255).to(torch.uint8)
    assert measure(noisy) < true_psnr - 4


def test_another_scene_that_agrees_with_itself_scores_as_high(pixels, true_psnr):
    assert measure(pixels.flip(1)) == pytest.approx(true_psnr, abs=2)


def test_the_number_is_that_of_the_seed(pixels):
    few = {"steps": 5}
    state = torch.random.get_rng_state()
    first, again = measure(pixels, **few), measure(pixels, **few)
    assert first == again
    assert measure(pixels, **few, seed=1) != first
    assert torch.equal(torch.random.get_rng_state(), state)


def test_gradients_flow_whatever_surrounds_it(pixels):
    with torch.no_grad():
        inside = measure(pixels, steps=5)
    assert inside == measure(pixels, steps=5) != measure(pixels, steps=0)


def test_only_the_views_between_are_scored(pixels):
    """Held-out views of another colour change the number, but not the field: their error is a closed form."""
    white = torch.full_like(pixels, 255)
    black_held_out = white.clone()
    black_held_out[1::2] = 0
    assert measure(white, steps=60) > 35
    assert measure(black_held_out, steps=60) == pytest.approx(0, abs=0.2)


def test_one_view_alone_has_nothing_to_agree_with(pixels):
    assert measure(pixels[:1], CAMERAS[:1]) is None


def test_true_views_are_fitted_once(pixels, monkeypatch):
    consistency = Consistency(**SETTINGS | {"steps": 2})
    calls, fit = [], Consistency._fit
    monkeypatch.setattr(Consistency, "_fit", lambda *arguments: (calls.append(1), fit(*arguments)))
    place = "scene", CAMERAS, ring(1, size=16), NEAR, FAR
    first = consistency.measure_truth(pixels, *place)
    assert consistency.measure_truth(pixels, *place) == first == consistency.measure(pixels, *place)
    assert len(calls) == 2
    assert consistency.measure_truth(255 - pixels, *place) != first


def test_only_the_first_scenes_are_measured():
    limited, all_, none = (Consistency(**SETTINGS | {"scenes": n}) for n in (2, None, 0))
    assert [limited.measures(k) for k in range(4)] == [True, True, False, False]
    assert all_.measures(10**6) and not none.measures(0)


def test_views_are_spread_evenly():
    assert evenly(5, 9).tolist() == [0, 1, 2, 3, 4]
    assert evenly(101, 5).tolist() == [0, 25, 50, 75, 100]
