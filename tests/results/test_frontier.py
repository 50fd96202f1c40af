import numpy as np
import pytest

from nerfdiff.results.frontier import frontier


def dominated(one, points) -> bool:
    """The definition, for every pair."""
    cost, quality = one
    return any(c <= cost and q >= quality and (c < cost or q > quality) for c, q in points)


@pytest.mark.parametrize("seed", range(20))
def test_the_frontier_is_that_of_all_pairs(seed):
    rng = np.random.default_rng(seed)
    # few distinct numbers, so that there are ties in either and twins in both
    cost, quality = rng.integers(0, 12, 60).astype(float), rng.integers(0, 12, 60).astype(float)
    points = list(zip(cost, quality, strict=True))
    expected = {n for n in range(60) if not dominated(points[n], points)}
    found = frontier(cost, quality)
    assert set(found) == expected and len(found) == len(expected)
    assert (np.diff(cost[found]) >= 0).all() and (np.diff(quality[found]) >= 0).all()


def test_one_point_is_a_frontier_and_none_is_none():
    assert frontier(np.array([3.0]), np.array([1.0])) == [0]
    assert frontier(np.array([]), np.array([])) == []
