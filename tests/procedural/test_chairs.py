import numpy as np
import pytest

from closed_surface import assert_closed
from procedural.chairs import STYLES, build_chair


def chairs(style, count=12):
    return [build_chair(np.random.default_rng(seed), {style: 1.0}) for seed in range(count)]


@pytest.mark.parametrize("style", STYLES)
def test_every_surface_is_closed_and_within_the_unit_diagonal(style):
    for chair in chairs(style):
        assert chair.style == style
        for part in chair.parts:
            assert_closed(part)
        low, high = chair.bounds()
        assert np.allclose(low, -high)
        assert np.linalg.norm(high - low) == pytest.approx(1)


@pytest.mark.parametrize("style", STYLES)
def test_the_back_is_behind_the_seat_so_that_chairs_face_minus_y(style):
    for chair in chairs(style):
        points = np.concatenate([p.vertices for p in chair.parts])
        low, high = chair.bounds()
        top = points[points[:, 2] > low[2] + 0.93 * (high[2] - low[2])]
        assert top[:, 1].mean() > 0.2 * high[1]


@pytest.mark.parametrize("style", STYLES)
def test_left_and_right_are_alike_above_the_legs(style):
    for chair in chairs(style, 6):
        # The star base stands at any angle, which shifts the bounding box: compare with the seat.
        seat = (chair.named("seat") + chair.named("cushion"))[0]
        points = np.concatenate([p.vertices for p in chair.parts if p.vertices[:, 2].mean() > 0])
        assert points[:, 0].mean() == pytest.approx(seat.vertices[:, 0].mean(), abs=1e-9)


def test_same_seed_same_chair_and_other_seeds_other_chairs():
    weights = dict.fromkeys(STYLES, 1.0)
    a, b, c = (build_chair(np.random.default_rng(s), weights) for s in (3, 3, 4))
    assert all(
        np.array_equal(p.vertices, q.vertices) and p.colour == q.colour for p, q in zip(a.parts, b.parts, strict=True)
    )
    assert not np.allclose(a.bounds(), c.bounds())


def test_a_shell_cushion_does_not_reach_through_the_shell():
    found = 0
    for chair in chairs("shell", 30):
        (shell,) = chair.named("seat")
        under = shell.vertices[len(shell.vertices) // 2 :]
        for cushion in chair.named("cushion"):
            found += 1
            lowest = cushion.vertices[len(cushion.vertices) // 2 :]
            for x, y, z in lowest:
                nearest = under[np.argmin((under[:, 0] - x) ** 2 + (under[:, 1] - y) ** 2)]
                assert z > nearest[2] - 0.004
    assert found > 3
