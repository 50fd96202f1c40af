import numpy as np
import pytest

from closed_surface import assert_closed
from procedural.car_proportions import STYLES
from procedural.cars import build_car


def cars(style, count=8):
    return [build_car(np.random.default_rng(seed), {style: 1.0}) for seed in range(count)]


def centre(part):
    return (part.vertices.min(axis=0) + part.vertices.max(axis=0)) / 2


@pytest.mark.parametrize("style", STYLES)
def test_every_surface_is_closed_and_within_the_unit_diagonal(style):
    for car in cars(style):
        for part in car.parts:
            assert_closed(part)
            assert np.isfinite(part.vertices).all()
        low, high = car.bounds()
        assert np.allclose(low, -high)
        assert np.linalg.norm(high - low) == pytest.approx(1)


@pytest.mark.parametrize("style", STYLES)
def test_cars_face_minus_y_and_stand_on_their_wheels(style):
    for car in cars(style):
        low, high = car.bounds()
        assert car.style == style
        assert all(centre(p)[1] < 0.8 * low[1] for p in car.named("headlight"))
        assert all(centre(p)[1] > 0.8 * high[1] for p in car.named("tail_light"))
        assert {len(car.named(n)) for n in ("headlight", "tail_light")} == {2}
        tyres = car.named("tyre")
        assert len(tyres) == 4
        assert all(p.vertices[:, 2].min() < low[2] + 0.01 for p in tyres)
        corners = {tuple(np.sign(centre(p)[:2])) for p in tyres}
        assert corners == {(-1, -1), (-1, 1), (1, -1), (1, 1)}


@pytest.mark.parametrize("style", STYLES)
def test_windows_lie_on_the_cabin_and_show_outside_it(style):
    for car in cars(style):
        (cabin,) = car.named("cabin")
        for window in car.named("side_window"):
            # Seen from the side, the window lies within the cabin's outline but is further out.
            y, z = window.vertices[:, 1], window.vertices[:, 2]
            assert y.min() >= cabin.vertices[:, 1].min() and y.max() <= cabin.vertices[:, 1].max()
            assert z.min() >= cabin.vertices[:, 2].min() and z.max() <= cabin.vertices[:, 2].max()
            assert np.abs(window.vertices[:, 0]).max() < np.abs(cabin.vertices[:, 0]).max()


def test_styles_differ_in_the_shape_a_person_would_name():
    def height_to_length(style):
        return np.mean([(c.bounds()[1][2] / c.bounds()[1][1]) for c in cars(style)])

    assert height_to_length("sports") < height_to_length("sedan") < height_to_length("suv") < height_to_length("van")
    assert all(car.named("bed_wall") for car in cars("pickup", 3))
    # A boot: behind the rear window a sedan's roof is gone, a wagon's is not.
    for style, lowest, highest in (("sedan", 0.10, 0.6), ("wagon", -0.02, 0.12)):
        for car in cars(style):
            behind = car.bounds()[1][1] - car.named("cabin")[0].vertices[:, 1].max()
            assert lowest * 0.5 < behind < highest


def test_same_seed_same_car_and_other_seeds_other_cars():
    weights = dict.fromkeys(STYLES, 1.0)
    a, b, c = (build_car(np.random.default_rng(s), weights) for s in (3, 3, 4))
    assert all(
        np.array_equal(p.vertices, q.vertices) and p.colour == q.colour for p, q in zip(a.parts, b.parts, strict=True)
    )
    assert not np.allclose(a.bounds(), c.bounds())


def test_weights_decide_how_often_a_style_occurs():
    weights = {"sedan": 3.0, "van": 1.0, "suv": 0.0}
    drawn = [build_car(np.random.default_rng(s), weights).style for s in range(60)]
    # Binomial(60, 3/4): mean 45, standard deviation 3.4.
    assert 32 < drawn.count("sedan") < 58
    assert drawn.count("sedan") + drawn.count("van") == 60
