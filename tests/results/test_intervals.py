import numpy as np
import pytest

from nerfdiff.results.intervals import Bootstrap, Estimate, spread
from nerfdiff.utils.errors import ConfigError


def test_intervals_are_those_of_a_loop_over_draws():
    values = np.random.default_rng(1).normal(20, 3, 12)
    found = Bootstrap(resamples=400, level=0.9, seed=7)(values)
    rng = np.random.default_rng(7)
    means = sorted(sum(values[i] for i in rng.integers(12, size=12)) / 12 for _ in range(400))
    assert found.mean == pytest.approx(sum(values) / 12)
    # 5% and 95% of 400 values, between neighbours, as quantiles are usually defined
    assert found.low == pytest.approx(means[19] + 0.95 * (means[20] - means[19]))
    assert found.high == pytest.approx(means[379] + 0.05 * (means[380] - means[379]))


def test_intervals_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    bootstrap = Bootstrap(resamples=500, level=0.9, seed=0)
    found = [bootstrap(rng.normal(5, 2, 40)) for _ in range(400)]
    covered = sum(low <= 5 <= high for _, low, high in found) / len(found)
    assert 0.84 < covered < 0.94


def test_what_makes_every_scene_hard_cancels_in_differences():
    rng = np.random.default_rng(0)
    hardness, gain = rng.normal(0, 5, 30), rng.normal(0.5, 0.1, 30)
    bootstrap = Bootstrap(resamples=2000, level=0.95, seed=0)
    apart, paired = bootstrap(20 + hardness + gain), bootstrap(gain)
    assert paired.high - paired.low < 0.05 * (apart.high - apart.low)
    assert paired.low > 0.4


def test_one_value_has_no_interval():
    assert Bootstrap(resamples=10, level=0.95, seed=0)(np.array([3.0])) == Estimate(3.0, None, None)
    assert spread([3.0]) == (3.0, None, None)
    assert spread([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)


@pytest.mark.parametrize("wrong", [{"resamples": 0}, {"level": 1.0}, {"level": 0.0}])
def test_values_out_of_range_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Bootstrap(**({"resamples": 10, "level": 0.95, "seed": 0} | wrong))
