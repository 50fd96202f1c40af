"""Distillation and evaluation in shards, and their merging: what one run of all scenes gives."""

import csv
import shutil

import pytest
import torch
from hydra import compose, initialize_config_dir

from nerfdiff.cli import CONF, load_config
from nerfdiff.evaluation.distill import distill
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.evaluation.merge import _ranges, merge_shards
from nerfdiff.metrics.sets import FrechetDistance, add_statistics, write_statistics
from nerfdiff.results.frame import read_runs
from nerfdiff.results.row import read_rows
from nerfdiff.sweeps.merged import MergeShards
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.shard import Shard
from training_fixtures import evaluation_overrides, train_to_evaluate, write_dataset

MEASURED = (
    *("psnr", "ssim", "st_lpips_vgg", "fd_st_vgg", "sharpness", "mask_iou", "floaters", "consistency_psnr"),
    *("denoiser_calls", "field_queries", "n_scenes", "n_views", "fid_n", "consistency_n", "blank_scenes", "K"),
    *("run_id", "config_sha256", "split_sha256", "status", "fallbacks", "suspects", "verdict", "shard"),
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"), scenes=5, views=3)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    train_to_evaluate(data, folder)
    return folder


def config(data, run, out, *more, command="evaluate"):
    small = (
        "baselines=false",
        "sheet.scenes=0",
        "dashboard=null",
        "metrics.consistency.steps=2",
        "metrics.geometry.floater_rays=64",
    )
    none = "orbit.frames=0" if command == "distill" else "orbit.scenes=0"
    small = small[command == "distill" :]
    return load_config(command, evaluation_overrides(data, run, out, none, *small, "metrics.min_size=20", *more))


def merge(folder):
    return merge_shards(load_config("merge_shards", [f"shards={folder}"]))


def scenes_of(row, home):
    with open(home / row.folder / "scores" / row.strategy / "per_scene.csv") as file:
        return {line["scene"]: {k: v for k, v in line.items() if k != "distill"} for line in csv.DictReader(file)}


@pytest.fixture(scope="module")
def whole(data, run, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    return out, evaluate(config(data, run, out, "metrics.consistency.scenes=3"))


@pytest.fixture(scope="module")
def made(data, run, tmp_path_factory):
    """Both shards of two, the second made first."""
    out = tmp_path_factory.mktemp("shards")
    for number in (2, 1):
        evaluate(config(data, run, out, "metrics.consistency.scenes=3", f"shard={number}/2"))
    return out


@pytest.fixture
def shards(made, tmp_path):
    return shutil.copytree(made, tmp_path / "shards")


def test_merged_shards_are_what_one_run_of_all_scenes_is(whole, shards):
    out, alone = whole
    rows = merge(shards)
    assert [row.strategy for row in rows] == ["none"]
    for row, other in zip(rows, sorted(alone, key=lambda row: row.strategy), strict=True):
        for name in MEASURED:
            expected = getattr(other, name)
            if isinstance(expected, float):
                expected = pytest.approx(expected, rel=1e-6, abs=1e-6)
            assert getattr(row, name) == expected, name
        assert row.folder.rpartition("/")[2] == other.folder.rpartition("/")[2]
        assert scenes_of(row, shards) == scenes_of(other, out)
    assert rows[0].scene_s["n"] == 3 and rows[0].timing_s > 0  # the first scene of each process warms up
    shown = [run.row.run_id for run in read_runs(shards / "results.jsonl")]
    assert shown == [row.run_id for row in rows]  # and no shard is


def test_merging_again_adds_nothing_and_a_shard_made_twice_counts_once(data, run, shards):
    rows = merge(shards)
    again = shutil.copytree(next(shards.glob("none-*")), shards / "elsewhere" / "none-x")
    assert again.is_dir() and merge(shards) == rows
    merged = [row for row in read_rows(shards / "results.jsonl") if row.shard is None]
    assert merged == rows and {row.n_scenes for row in rows} == {5}
    assert (shards / "table.md").is_file()


def test_a_sweep_of_shards_has_a_job_for_each_and_merges_them_at_its_end(shards):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["ckpt=demo", "sweep=shards", "shards=3", f"hydra.sweep.dir={shards}"]
        sweep = compose("distill", words, return_hydra_config=True)
    assert sweep.hydra.sweeper.params.shard == "1/3,2/3,3/3" and sweep.hydra.sweeper.batch_size is None
    MergeShards().on_multirun_end(sweep)
    assert read_rows(shards / "results.jsonl")[-1].n_scenes == 5
    for path in shards.glob("*/scores/none/shard.json"):
        path.unlink()
    with pytest.raises(SystemExit, match="no complete shard"):
        MergeShards().on_multirun_end(sweep)


def test_a_shard_that_is_missing_is_named_and_nothing_is_merged(data, run, shards):
    shutil.rmtree(
        next(path.parents[2] for path in shards.glob("*/scores/none/shard.json") if '"1/2"' in path.read_text())
    )
    before = (shards / "results.jsonl").read_bytes()
    with pytest.raises(DataError, match=r"none: 1 of 2 shards are not complete \(1\)\. Run these again"):
        merge(shards)
    assert (shards / "results.jsonl").read_bytes() == before
    evaluate(config(data, run, shards, "metrics.consistency.scenes=3", "shard=1/2", "seed=1"))
    with pytest.raises(DataError, match=r"shard \d/2 is of another run: it differs in seed"):
        merge(shards)


@pytest.mark.parametrize("damage", ["per_scene.csv", "costs.csv", "sets.npz", "shard.json", "a scene"])
def test_damaged_shards_are_named(damage, shards):
    folder = next(shards.glob("*/scores/none"))
    if damage == "a scene":
        lines = (folder / "per_scene.csv").read_text().splitlines(keepends=True)
        (folder / "per_scene.csv").write_text("".join(lines[:-1]))
        damage = "per_scene.csv"
    else:
        content = (folder / damage).read_bytes()
        (folder / damage).write_bytes(b"" if damage == "costs.csv" else content[: len(content) // 3])
    with pytest.raises(DataError, match=str(folder / damage)):
        merge(shards)


def test_distillation_is_sharded_and_goes_on(data, run, tmp_path):
    more = "strategy=copy_input", "metrics.st_lpips=false", "metrics.consistency.scenes=1", "data.eval_scenes=3"

    def make(number):
        return distill(config(data, run, tmp_path, *more, f"shard={number}/2", command="distill"))

    def made():
        return {path.parent.name: path.stat().st_mtime_ns for path in tmp_path.glob("*/predictions/*/*/scene.json")}

    rows = [make(1), make(2)]
    assert [(row.shard, row.n_scenes) for row in rows] == [("1/2", 2), ("2/2", 1)]
    before = made()
    assert sorted(before) == ["scene0", "scene2", "scene4"]
    make(2)
    assert made() == before
    (row,) = merge(tmp_path)
    assert row.n_scenes == 3 and row.psnr == pytest.approx((2 * rows[0].psnr + rows[1].psnr) / 3, rel=1e-6)
    assert row.fd_st_vgg is None and not any("shard" in word for word in row.overrides or ())


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "a/b", "1/0", "-1/3"])
def test_what_is_no_shard_is_refused(text):
    with pytest.raises(ConfigError, match=f"shard={text}"):
        Shard.read(text)


def test_more_shards_than_scenes_and_shards_of_a_picture_are_refused(data, run, tmp_path):
    with pytest.raises(ConfigError, match="shard=6/6: there are 5 scenes"):
        evaluate(config(data, run, tmp_path, "shard=6/6"))
    with pytest.raises(ConfigError, match="shard=1/2 is of a dataset"):
        distill(config(data, run, tmp_path, "shard=1/2", "image=car.png", command="distill"))


def test_all_shards_are_all_scenes_once():
    items = list(range(103))
    for of in (1, 7, 100, 103):
        shares = [Shard(number, of).share(items) for number in range(1, of + 1)]
        assert (
            sorted(item for share in shares for item in share) == items
            and max(map(len, shares)) - min(map(len, shares)) <= 1
        )
        assert all(Shard(n + 1, of).index(p) == item for n, s in enumerate(shares) for p, item in enumerate(s))
    assert _ranges([1, 2, 3, 7, 9, 10]) == "1-3,7,9-10"


def test_distances_of_merged_statistics_are_those_of_all_features(tmp_path):
    torch.manual_seed(0)
    pairs = torch.randn(2, 90, 12, dtype=torch.float64) + 5
    whole, merged = FrechetDistance(), FrechetDistance()
    whole.update(*pairs)
    for number, part in enumerate((pairs[:, :1], pairs[:, 1:60], pairs[:, 60:60], pairs[:, 60:])):
        of = FrechetDistance()
        of.update(*part)
        write_statistics(tmp_path / f"{number}.npz", fid=FrechetDistance(), mine=of)
        nothing = FrechetDistance()
        add_statistics(tmp_path / f"{number}.npz", fid=nothing, mine=merged)
        assert nothing.compute() is None
    assert merged.compute() == pytest.approx(whole.compute(), rel=1e-10) and merged.truth.count == 90
