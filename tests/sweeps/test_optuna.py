"""Optuna on a space whose frontier is known."""

import sys

import pytest

from nerfdiff.results.row import ResultRow
from nerfdiff.sweeps.optuna_proposals import Optuna
from nerfdiff.sweeps.proposals import Random
from nerfdiff.sweeps.space import Axis, Space
from nerfdiff.utils.errors import ConfigError

pytest.importorskip("optuna", reason="Optuna is an optional extra: pip install optuna")

GOALS = ["psnr", "scene_s"]
SAMPLES = Axis("samples", tuple(f"samples={i}" for i in range(1, 9)))
SPACE = Space(
    (
        (Axis("strategy", ("strategy=none",)), SAMPLES),
        (
            Axis("strategy", ("strategy=ngd",)),
            *(Axis(key, tuple(f"{key}={i}" for i in range(16))) for key in ("steps", "views", "noise")),
            SAMPLES,
        ),
    ),
    ("strategy",),
)


def measured(configuration):
    """PSNR and seconds: noise only hurts, twelve views are best, steps cost and gain ever less."""
    values = dict(word.split("=") for word in configuration)
    samples, steps = int(values["samples"]), int(values.get("steps", 0))
    psnr = 20 + 0.1 * samples + 3 * (1 - 2 ** (-steps / 3))
    if "steps" in values:
        psnr -= 0.3 * abs(int(values["views"]) - 12) + 0.5 * int(values["noise"])
    return psnr, 0.1 * samples + 0.3 * steps


def row(configuration, **fields):
    psnr, seconds = measured(configuration)
    timing = {"n": 1, "median": seconds, "iqr": 0.0}
    return ResultRow(**{"run_id": "x", "psnr": psnr, "scene_s": timing} | fields)


def volume(tried):
    """Dominated by the frontier, up to 6 s and down to 15 dB."""
    area, until = 0.0, 6.0
    for seconds, psnr in sorted((measured(c)[::-1] for c in tried), key=lambda point: (-point[1], point[0])):
        area += max(0.0, until - seconds) * max(0.0, psnr - 15)
        until = min(until, seconds)
    return area


def search(seed, configurations=48, size=8):
    proposals, tried = Optuna(configurations, 12, seed, GOALS), {}
    while batch := proposals.more(SPACE, tried, size):
        assert len(batch) <= size and not set(batch) & set(tried) and len(set(batch)) == len(batch)
        tried |= {configuration: [row(configuration)] for configuration in batch}
    return tried


def test_it_finds_more_of_the_frontier_than_chance():
    found = [search(seed) for seed in range(3)]
    assert [len(tried) for tried in found] == [48] * 3
    chance = [Random(48, seed).known(SPACE, {}) for seed in range(3)]
    assert sum(map(volume, found)) > sum(map(volume, chance))
    assert all(set(tried) <= set(SPACE) for tried in found)


def test_it_goes_on_from_the_rows_that_there_are():
    tried = search(0, configurations=24)
    longer = Optuna(32, 12, 0, GOALS)
    assert longer.known(SPACE, tried) == list(tried)
    assert len(longer.more(SPACE, tried, 100)) == 8
    assert Optuna(24, 12, 0, GOALS).more(SPACE, tried, 8) == []


def test_it_learns_the_mean_over_seeds_and_nothing_from_failures():
    configuration = ("strategy=ngd", "steps=3", "views=12", "noise=0", "samples=1")
    lost = ("strategy=none", "samples=1")
    seeds = [row(configuration, psnr=20.0), row(configuration, psnr=22.0), row(configuration, status="oom")]
    tried = {configuration: seeds, lost: [row(lost, status="nan")], ("strategy=none", "samples=2"): [row(lost)]}
    tried[("strategy=none", "samples=2")] = [row(lost, psnr=float("nan"))]
    study = Optuna(8, 2, 0, GOALS)._study(SPACE, tried)
    assert [trial.values for trial in study.trials] == [[21.0, pytest.approx(1.0)], None, None]


def test_what_cannot_be_searched_is_said():
    with pytest.raises(ConfigError, match=r"objectives: psnrr is no metric and no field"):
        Optuna(8, 2, 0, ["psnrr"])
    with pytest.raises(ConfigError, match="objectives is empty"):
        Optuna(8, 2, 0, [])
    with pytest.raises(ConfigError, match="startup must be at least 1"):
        Optuna(8, 0, 0, GOALS)
    configuration = ("strategy=none", "samples=1")
    with pytest.raises(ConfigError, match=r"objectives: lpips was not measured"):
        Optuna(8, 2, 0, ["lpips"]).more(SPACE, {configuration: [row(configuration)]}, 4)


def test_without_optuna_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match="pip install optuna"):
        Optuna(8, 2, 0, GOALS)
