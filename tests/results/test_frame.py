import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from chart_fixtures import SCENES, failed, result, timing, write_results, write_scores
from nerfdiff.results.frame import (
    Run,
    configurations,
    configurations_frame,
    find_results,
    newest,
    read_runs,
    runs_frame,
)
from nerfdiff.results.intervals import Bootstrap, Estimate
from nerfdiff.utils.errors import DataError

BOOTSTRAP = Bootstrap(resamples=500, level=0.9, seed=3)


def runs_of(folder, *rows):
    return read_runs(write_results(folder, *rows) / "results.jsonl")


def test_seeds_make_one_configuration_whatever_the_order_of_their_overrides(tmp_path):
    second = result(seed=1)
    second.overrides.reverse()
    found = configurations(runs_of(tmp_path, result(), second, result("slow"), result("cheap", 1)), BOOTSTRAP)
    assert [(c.row.run_id, c.seeds) for c in found] == [("good-0", [0, 1]), ("slow-0", [0]), ("cheap-1", [1])]


@pytest.mark.parametrize(
    "other",
    [
        {"device": "H100", "cpu": "x"}, {"cpu": "Other CPU"}, {"n_scenes": 5}, {"image_size": [64, 64]},
        {"ckpt_sha256": "b"}, {"backend": "triton"}, {"field": "pixelnerf"}, {"strategy": "mean_image"},
    ],
)  # fmt: skip
def test_what_differs_in_anything_but_the_seed_is_another_configuration(tmp_path, other):
    found = configurations(runs_of(tmp_path, result(), dataclasses.replace(result(seed=1), **other)), BOOTSTRAP)
    assert [c.seeds for c in found] == [[0], [1]]


def test_a_run_that_was_run_again_counts_once(tmp_path):
    early = [failed(seed=1), result(), result(seed=1), result(psnr=21.0), failed(seed=2), failed(seed=2, error="2nd")]
    runs = runs_of(tmp_path, *early)
    assert [(r.row.seed, r.row.status, r.row.psnr or r.row.error) for r in newest(runs)] == [
        (1, "ok", 22.0), (0, "ok", 21.0), (2, "oom", "2nd"),
    ]  # fmt: skip
    (found,) = configurations(runs, BOOTSTRAP)
    assert found.seeds == [1, 0] and found.failed == 1


def test_a_later_failure_hides_no_success(tmp_path):
    (found,) = configurations(runs_of(tmp_path, result(), failed(device="cpu", cpu="Test CPU")), BOOTSTRAP)
    assert found.seeds == [0] and found.failed == 1


def test_a_failure_on_another_device_stays(tmp_path):
    runs = runs_of(tmp_path, failed(device="H100"), failed(device="cpu", cpu="Test CPU"), result())
    assert [(r.device, r.row.status) for r in newest(runs)] == [("H100", "oom"), ("Test CPU", "ok")]


def test_failures_are_those_of_their_device_or_of_any(tmp_path):
    others = [failed(seed=1, device="H100"), failed(seed=2, device="cpu", cpu="Test CPU"), failed(seed=3)]
    found = configurations(
        runs_of(tmp_path, result(), result(device="H100"), result(device="H200"), *others), BOOTSTRAP
    )
    assert [c.failed for c in found] == [2, 2, 1]


def test_a_run_in_several_files_counts_once_and_the_newest_is_kept(tmp_path):
    later = dataclasses.replace(result(psnr=23.0), time="2026-02-01T00:00:00+00:00")
    runs = [
        *runs_of(tmp_path / "a", later, failed("slow")),
        *runs_of(tmp_path / "b", result(), failed("slow"), result(seed=1)),
    ]
    assert [(r.row.run_id, r.row.psnr) for r in newest(runs)] == [("slow-0", None), ("good-1", 22.0), ("good-0", 23.0)]
    (found,) = configurations(runs, BOOTSTRAP)
    assert found.seeds == [1, 0] and found.runs[1].home == tmp_path / "a"


def test_failures_of_one_configuration_are_not_those_of_another(tmp_path):
    found = configurations(runs_of(tmp_path, result(), result("slow"), failed("slow", 1), failed("slow", 2)), BOOTSTRAP)
    assert [c.failed for c in found] == [0, 2]
    assert configurations(runs_of(tmp_path / "none", failed(), failed(seed=1)), BOOTSTRAP) == []


def test_intervals_are_over_scenes_and_seeds(tmp_path):
    values = np.random.default_rng(0).normal(20, 2, (2, 3))
    rows = [result(seed=seed, folder=f"run{seed}", psnr=float(values[seed].mean())) for seed in (0, 1)]
    for seed in (0, 1):
        # in another order of scenes: they belong together by name
        order = list(zip(SCENES, values[seed], strict=True))[:: 1 if seed else -1]
        write_scores(tmp_path / f"run{seed}", "ngd", dict(order))
    (found,) = configurations(runs_of(tmp_path, *rows), BOOTSTRAP)
    (expected,) = BOOTSTRAP.over_seeds_and_scenes(values[None])
    assert found.estimates["psnr"] == pytest.approx(expected)
    assert found.estimates["psnr"].mean == pytest.approx(values.mean())
    # no scene has this one, the row does
    assert found.estimates["st_lpips_vgg"] == (0.2, 0.2, 0.2)


def test_intervals_over_seeds_and_scenes_are_those_of_a_loop_over_draws():
    values = np.random.default_rng(1).normal(0, 1, (1, 4, 6))
    found = Bootstrap(resamples=5_000, level=0.9, seed=0).over_seeds_and_scenes(values)[0]
    rng = np.random.default_rng(5)
    means = []
    for _ in range(5_000):
        seeds, scenes = rng.integers(4, size=4), rng.integers(6, size=6)
        means.append(np.mean([[values[0, s, c] for c in scenes] for s in seeds]))
    assert found.mean == pytest.approx(values.mean())
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(means, [0.05, 0.95])), abs=0.04)


def test_with_one_seed_the_intervals_are_those_over_scenes():
    values = np.random.default_rng(1).normal(0, 1, (2, 1, 9))
    found = BOOTSTRAP.over_seeds_and_scenes(values)
    assert [pytest.approx(BOOTSTRAP(each[0])) for each in values] == found
    assert BOOTSTRAP.over_seeds_and_scenes(np.array([[[2.0]]])) == [Estimate(2.0)]


def test_costs_are_per_scene_with_the_quartiles_of_all_seeds(tmp_path):
    rows = [
        result(scene_s=timing(10.0, 2.0), denoiser_calls=30, peak_mem_bytes=5),
        result(seed=1, scene_s=timing(14.0, 6.0), denoiser_calls=36, peak_mem_bytes=None),
    ]
    (found,) = configurations(runs_of(tmp_path, *rows), BOOTSTRAP)
    assert found.estimates["scene_s"] == (12.0, 9.0, 17.0)
    assert found.estimates["denoiser_calls"] == (11.0, 10.0, 12.0)
    assert "peak_mem_bytes" not in found.estimates  # not of all seeds: no mean would be of the configuration
    assert "distill_s" not in found.estimates


def test_tables_have_a_line_per_run_and_per_configuration(tmp_path):
    runs = runs_of(tmp_path, result(), result(seed=1, psnr=23.0), failed("slow"))
    lines = runs_frame(runs)
    assert lines[["run_id", "status", "scene_s_median"]].fillna(-1).to_numpy().tolist() == [
        ["good-0", "ok", 8.0], ["good-1", "ok", 8.0], ["slow-0", "oom", -1],
    ]  # fmt: skip
    assert set(lines["results"]) == {str(tmp_path)}
    table = configurations_frame(configurations(runs, BOOTSTRAP))
    assert table[["seeds", "failed", "strategy", "image_size"]].to_numpy().tolist() == [["0 1", 0, "ngd", "32x32"]]
    assert table[["psnr", "psnr_low", "psnr_high"]].to_numpy().tolist() == [[22.5, 22.0, 23.0]]
    assert table.loc[0, "overrides"] == "budget.inner_steps=4 ckpt=demo strategy=ngd"
    assert isinstance(runs_frame([]), pd.DataFrame) and configurations_frame([]).empty


def test_damaged_scores_are_told_and_the_rows_count(tmp_path):
    write_scores(tmp_path / "run", "ngd", {"a": "many"})
    told = []
    (found,) = configurations(runs_of(tmp_path, result(folder="run")), BOOTSTRAP, told.append)
    assert found.estimates["psnr"] == (22.0, None, None)
    assert re.search(r"run/scores/ngd/per_scene\.csv: cannot be read \(could not convert", *told)


def test_files_of_a_run_lie_within_the_results(tmp_path):
    """Wherever its row says that they are, and wherever links lead."""
    results, outside = tmp_path / "results", tmp_path / "outside"
    write_scores(outside, "ngd", {"a": 1.0})
    write_scores(results / "sub" / "run", "ngd", {"a": 2.0})
    (results / "link").symlink_to(outside)
    (results / "loop").symlink_to(results / "loop")
    own = ("scores", "ngd", "per_scene.csv")
    for folder in ("../outside", str(outside), "link", "loop", "run/../../outside", "\0", "x" * 5000, "gone"):
        run = Run(result(folder=folder), results)
        assert run.file() is None and run.file(*own) is None
        assert run.astray == (folder in ("../outside", str(outside), "link"))
    assert Run(result(folder="sub/run"), results).file(*own) == results / "sub" / "run" / Path(*own)
    assert Run(result(folder="sub/run"), results).file("..", "..", "..", "outside") is None
    # where both are results, one may name the other
    assert Run(result(folder="../../outside"), results / "sub", (tmp_path,)).file(*own) is not None


def test_results_are_found_at_any_depth_but_not_among_predictions(tmp_path):
    for place in ("b/deep", "a", "a/predictions/x"):
        write_results(tmp_path / place, result())
    assert find_results(tmp_path) == [tmp_path / "a" / "results.jsonl", tmp_path / "b" / "deep" / "results.jsonl"]
    assert find_results(tmp_path / "a" / "results.jsonl") == [tmp_path / "a" / "results.jsonl"]
    with pytest.raises(DataError, match=r"results=.*nowhere does not exist; name a folder of runs or a results\.jsonl"):
        find_results(tmp_path / "nowhere")
