import pytest
import torch

from nerfdiff.utils.randomness import generator, seed_of, spread_times


def test_seeds_depend_on_every_part_and_nothing_else():
    seeds = [seed_of(*parts) for parts in [(0,), (1,), (0, "a"), (0, "b"), ("0a",), (0, "a", 0), (0, 0, "a")]]
    assert len(set(seeds)) == len(seeds)
    assert seed_of(0, "a") == seed_of(0, "a") and all(0 <= seed < 2**63 for seed in seeds)


def test_generators_repeat():
    first, second = (torch.randn(4, generator=generator("cpu", 3, "x")) for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, torch.randn(4, generator=generator("cpu", 3, "y")))


@pytest.mark.parametrize("start", [0, 12_345, 10**12])
def test_consecutive_draws_cover_the_times_evenly(start):
    times = spread_times(torch.arange(start, start + 64), seed=5)
    assert (times >= 0).all() and (times < 1).all()
    # In a golden-ratio sequence of 64 no gap is wider than about 2.6 / 64.
    ascending = times.sort().values
    gaps = torch.cat([ascending, ascending[:1] + 1]).diff()
    assert float(gaps.max()) < 3 / 64
    assert float(times.mean()) == pytest.approx(0.5, abs=0.02)


def test_a_draw_has_its_time_whatever_batch_it_is_in():
    alone = [spread_times(torch.tensor([draw]), 0).item() for draw in (7, 8, 9)]
    assert spread_times(torch.tensor([7, 8, 9]), 0).tolist() == alone
