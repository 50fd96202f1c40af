import numpy as np
import pytest

from closed_surface import assert_closed
from procedural.products.catalogue import STYLES, build_product
from procedural.texture import PATTERNS, SIDE, Texture, box_coordinates


def products(style, count=10):
    return [build_product(np.random.default_rng(seed), {style: 1.0}) for seed in range(count)]


@pytest.mark.parametrize("style", STYLES)
def test_every_surface_is_closed_and_stands_on_the_ground_at_a_product_s_size(style):
    for product in products(style):
        assert product.style == style
        for part in product.parts:
            assert np.isfinite(part.vertices).all(), part.name
            assert_closed(part)
        low, high = product.bounds()
        assert abs(low[2]) < 0.02
        assert 0.25 < (high - low).max() < 2.6


def test_proportions_are_those_of_the_things_named():
    def sizes(style):
        return np.array([np.ptp(p.bounds(), axis=0) for p in products(style)])

    assert (sizes("rug")[:, 2] < 0.05).all()
    assert (sizes("sofa")[:, 0] > sizes("sofa")[:, 2]).all()
    assert (sizes("bed")[:, 1] > 1.9).all()
    assert (sizes("shelf")[:, 1] < 0.45).all() and (sizes("shelf")[:, 2] > 0.75).all()
    for table in products("table"):
        (top,) = table.named("top")
        assert top.vertices[:, 2].max() > 0.95 * table.bounds()[1][2]
    for bed in products("bed"):
        backs = [p.vertices[:, 1].mean() for p in bed.named("headboard") + bed.named("crest")]
        assert min(backs) > 0.9  # the head is at +y
    for cabinet in products("cabinet"):
        (body,) = cabinet.named("body")
        fronts = np.concatenate([p.vertices for p in cabinet.named("front")])
        assert fronts[:, 1].min() < body.vertices[:, 1].min() and fronts[:, 1].max() < 0
    for sofa in products("sofa"):
        assert sofa.named("back")[0].vertices[:, 1].mean() > 0.2


def test_same_seed_same_product_and_other_seeds_others():
    weights = dict.fromkeys(STYLES, 1.0)
    a, b, c = (build_product(np.random.default_rng(seed), weights) for seed in (3, 3, 4))
    assert len(a.parts) == len(b.parts)
    for p, q in zip(a.parts, b.parts, strict=True):
        assert np.array_equal(p.vertices, q.vertices)
        assert (p.colour, p.finish, p.texture) == (q.colour, q.finish, q.texture)
    assert not np.allclose(a.bounds(), c.bounds())


def test_most_products_wear_a_pattern_and_many_patterns_occur():
    weights = dict.fromkeys(STYLES, 1.0)
    drawn = [build_product(np.random.default_rng(seed), weights) for seed in range(120)]
    patterned = [{p.texture.pattern for p in product.parts if p.texture} for product in drawn]
    assert np.mean([bool(found) for found in patterned]) > 0.6
    assert set().union(*patterned) >= {"wood", "weave", "stripes", "checks", "bordered"}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_are_seeded_keep_to_their_two_colours_and_vary(pattern):
    dark, light = (0.1, 0.1, 0.1), (0.9, 0.8, 0.7)
    a, b = (Texture(pattern, light, (1.0, 1.0), 5).pixels(dark) for _ in range(2))
    assert a.shape == (SIDE, SIDE, 3) and np.array_equal(a, b)
    assert a.min() >= round(0.1 * 255) and (a.reshape(-1, 3).max(axis=0) <= np.round(np.array(light) * 255)).all()
    assert a.std() > 5


@pytest.mark.parametrize("pattern", ["wood", "weave", "speckle", "marble"])
def test_repeating_patterns_have_no_seam(pattern):
    pixels = Texture(pattern, (0.9, 0.9, 0.9), (1.0, 1.0), 3).pixels((0.1, 0.1, 0.1))[..., 0].astype(float)
    for axis in (0, 1):
        inner = np.abs(np.diff(pixels, axis=axis)).mean()
        seam = np.abs(np.take(pixels, 0, axis) - np.take(pixels, -1, axis)).mean()
        assert seam < 4 * inner + 1


def test_box_coordinates_run_along_the_longer_side_in_units_of_the_repeat():
    # One triangle on top of a board 2 long in y, 1 wide in x; one on its side.
    corners = np.array([[(0, 0, 0.1), (1, 0, 0.1), (1, 2, 0.1)], [(1, 0, 0), (1, 2, 0), (1, 2, 0.1)]], float)
    uv = box_coordinates(corners, Texture("wood", (0, 0, 0), (0.5, 0.25)))
    assert np.allclose(uv[0], [(0, 0), (0, 4), (4, 4)])
    assert np.allclose(uv[1], [(0, 0), (4, 0), (4, 0.4)])
    once = box_coordinates(corners[:1], Texture("bordered", (0, 0, 0), (0, 0)))
    assert np.allclose(once[0], [(0, 0), (0, 1), (1, 1)])
