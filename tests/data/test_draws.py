"""Draws are a pure function of seed and number, fair, and dealt out the same to any number of processes."""

from collections import Counter

import numpy as np
import pytest

from nerfdiff.data.draws import Draws, DrawSampler, random_bits, scene_order


@pytest.fixture
def draws() -> Draws:
    return Draws(seed=5, scenes=7, target_views=3, source_as_target=0.25)


def test_every_pass_visits_every_scene_once_in_another_order(draws):
    passes = [[draws.scene(n) for n in range(7 * p, 7 * p + 7)] for p in range(20)]
    assert all(sorted(order) == list(range(7)) for order in passes)
    assert len({tuple(order) for order in passes}) > 15


def test_draws_depend_on_nothing_but_seed_and_number(draws):
    forwards = [(draws.scene(n), draws.views(n, 6)) for n in range(40)]
    scene_order.cache_clear()
    again = Draws(seed=5, scenes=7, target_views=3, source_as_target=0.25)
    assert [(again.scene(n), again.views(n, 6)) for n in reversed(range(40))] == forwards[::-1]
    other = Draws(seed=6, scenes=7, target_views=3, source_as_target=0.25)
    assert [(other.scene(n), other.views(n, 6)) for n in range(40)] != forwards


def test_recorded_draws_stay_as_they_are(draws):
    """A checkpoint goes on with these: a change here changes every resumed run."""
    assert [draws.scene(n) for n in range(14)] == [2, 4, 3, 1, 5, 0, 6, 1, 4, 5, 3, 2, 6, 0]
    assert [draws.views(n, 6) for n in range(3)] == [(4, (5, 1, 0)), (4, (4, 1, 0)), (4, (0, 1, 5))]


def test_random_bits_are_far_apart_for_neighbouring_numbers():
    bits = {tuple(random_bits(seed, stream, n, 4)) for seed in range(3) for stream in (0, 1) for n in range(50)}
    assert len(bits) == 300
    assert len({value for row in bits for value in row}) == 1200


def test_targets_are_distinct_and_avoid_the_source(draws):
    first_is_source = 0
    for n in range(4000):
        source, targets = draws.views(n, 6)
        assert len(set(targets)) == 3 and {source, *targets} <= set(range(6))
        assert source not in targets[1:]
        first_is_source += targets[0] == source
    assert first_is_source / 4000 == pytest.approx(0.25, abs=0.03)


def test_views_are_drawn_evenly():
    draws = Draws(seed=0, scenes=3, target_views=1, source_as_target=0.0)
    pairs = Counter((source, target) for source, (target,) in (draws.views(n, 5) for n in range(10000)))
    assert len(pairs) == 20  # every ordered pair of different views
    assert min(pairs.values()) > 400 and max(pairs.values()) < 600


@pytest.mark.parametrize(("probability", "expected"), [(0.0, 0), (1.0, 500)])
def test_source_as_target_at_its_ends(probability, expected):
    draws = Draws(seed=0, scenes=3, target_views=2, source_as_target=probability)
    views = [draws.views(n, 5) for n in range(500)]
    assert sum(targets[0] == source for source, targets in views) == expected


def global_steps(batch_size: int, micro: int, world_size: int, start: int, total: int) -> list[list[int]]:
    """The draws of each optimizer step, joined over ranks and accumulated batches."""
    steps = [[] for _ in range(total - start)]
    for rank in range(world_size):
        batches = list(DrawSampler(batch_size, micro, rank, world_size, start, total))
        per_step = len(batches) // (total - start)
        for k, batch in enumerate(batches):
            assert len(batch) == micro
            steps[k // per_step] += batch
    return steps


@pytest.mark.parametrize(("world_size", "micro"), [(1, 12), (2, 6), (3, 4), (1, 3), (2, 2), (4, 1)])
def test_a_step_has_the_same_draws_on_any_number_of_ranks(world_size, micro):
    expected = [list(range(12 * step, 12 * step + 12)) for step in range(5)]
    assert global_steps(12, micro, world_size, 0, 5) == expected


@pytest.mark.parametrize(("world_size", "micro"), [(1, 12), (2, 3)])
def test_a_resumed_run_goes_on_with_the_next_draw(world_size, micro):
    whole = global_steps(12, micro, world_size, 0, 6)
    assert global_steps(12, micro, world_size, 4, 6) == whole[4:]


def test_the_length_is_that_of_the_whole_run():
    assert len(DrawSampler(12, 3, 1, 2, start_step=4, total_steps=6)) == 12
    assert len(list(DrawSampler(12, 3, 1, 2, start_step=4, total_steps=6))) == 4


def test_a_fixed_source_is_never_its_own_target_unless_asked():
    draws = Draws(seed=0, scenes=2, target_views=3, source_as_target=0.0)
    seen = set()
    for draw in range(50):
        source, targets = draws.views(draw, 6, source=4)
        assert source == 4 and 4 not in targets and len(set(targets)) == 3
        seen.update(targets)
    assert seen == {0, 1, 2, 3, 5}


def test_the_shift_of_reconstructed_inputs_has_the_wanted_variance_and_depends_on_the_draw_alone():
    draws = Draws(seed=5, scenes=7, target_views=1, source_as_target=0.5, source_target_noise=0.3)
    shifts = np.array([draws.shift(draw) for draw in range(4000)])
    assert np.abs(shifts.mean(0)).max() < 0.03
    np.testing.assert_allclose(np.cov(shifts.T), 0.3 * np.eye(3), atol=0.03)
    assert draws.shift(17) == tuple(shifts[17])
    assert Draws(seed=6, scenes=7, target_views=1, source_as_target=0.5, source_target_noise=0.3).shift(17) != tuple(
        shifts[17]
    )
    assert Draws(seed=5, scenes=7, target_views=1, source_as_target=0.5).shift(17) is None


def test_sources_can_be_kept_to_a_scenes_first_views():
    draws = Draws(seed=3, scenes=2, target_views=3, source_as_target=0.2, source_views=2)
    chosen = [draws.views(draw, 6) for draw in range(400)]
    assert {source for source, _ in chosen} == {0, 1}
    assert {target for _, targets in chosen for target in targets} == set(range(6))
