"""Tables of sweeps from rows and scores that are written by hand."""

import csv
import io
import json
import math
import os

import numpy as np
import pytest
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf
from rich.console import Console

from nerfdiff.evaluation import measure
from nerfdiff.metrics.predictions import FORMAT
from nerfdiff.metrics.summary import read_scores
from nerfdiff.results.intervals import Bootstrap
from nerfdiff.results.row import ResultRow, append_row, read_rows
from nerfdiff.sweeps import grid as sweep_grid
from nerfdiff.sweeps import orbits as sweep_orbits
from nerfdiff.sweeps import table as sweep_table
from nerfdiff.sweeps.frontier import Frontier
from nerfdiff.sweeps.jobs import Job, counterpart, group, jobs_of, planned
from nerfdiff.sweeps.lines import lines_of
from nerfdiff.sweeps.table import SweepTable
from nerfdiff.sweeps.text import to_csv, to_markdown, to_rich
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.hashes import sha256_values

BOOTSTRAP = Bootstrap(resamples=200, level=0.95, seed=0)
METRICS = {"psnr_floor": 1e-6}
PSNR = {("none", 0): [20.0, 24.0], ("none", 1): [20.0, 24.0], ("ngd", 0): [21.0, 26.0], ("ngd", 1): [22.0, 25.0]}
FD = {("none", 0): 300.0, ("none", 1): 300.0, ("ngd", 0): 180.0, ("ngd", 1): 160.0}


def sweep(folder, params, *overrides):
    """What Hydra hands to callbacks at the start of a multirun."""
    hydra = {"sweep": {"dir": str(folder)}, "sweeper": {"params": params}, "overrides": {"task": list(overrides)}}
    return OmegaConf.create({"hydra": hydra, "metrics": METRICS, "sheet": {"scenes": 2, "views": 1}, "data": {}})


def write_job(folder, overrides, strategy, seed, psnr, **fields):
    """A job that succeeded: its row, its plan and its scores."""
    identity = {"strategy": strategy, "seed": seed}
    run = folder / f"{strategy}-seed{seed}" / f"{strategy}-1234"
    predictions, scores = run / "predictions" / strategy, run / "scores" / strategy
    predictions.mkdir(parents=True)
    scores.mkdir(parents=True)
    (predictions / "plan.json").write_text(json.dumps({"format": FORMAT, "identity": identity, "scenes": ["a", "b"]}))
    rows = [f"{scene},3,0,{value},0.8,,\n" for scene, value in zip("ab", psnr, strict=True)]
    (scores / "per_scene.csv").write_text("scene,views,blank,psnr,ssim,lpips,floaters\n" + "".join(rows))
    row = ResultRow(
        run_id=f"{strategy}-{seed}",
        config_sha256=sha256_values([identity, strategy, METRICS]),
        folder=str(run.relative_to(folder)),
        overrides=list(overrides),
        seed=seed,
        strategy=strategy,
        psnr=float(np.mean(psnr)),
        **fields,
    )
    append_row(folder / "results.jsonl", row)


@pytest.fixture
def swept(tmp_path):
    """none and ngd succeeded with two seeds; sds failed with one and was not run with the other."""
    config = sweep(tmp_path, {"seed": "0,1", "strategy": "none,sds,ngd"}, "ckpt=demo")
    for (strategy, seed), psnr in PSNR.items():
        overrides = [f"seed={seed}", f"strategy={strategy}", "ckpt=demo"]
        seconds = {"n": 2, "median": 4.0 + seed, "iqr": 0.0} if strategy == "ngd" else None
        write_job(
            tmp_path, overrides, strategy, seed, psnr, fd_st_vgg=FD[strategy, seed], distill_s=seconds, fallbacks=seed
        )
    failure = ["seed=0", "strategy=sds", "ckpt=demo"]
    row = ResultRow(
        run_id="sds", overrides=failure, seed=0, strategy="sds", status="oom", error="no [bold] memory | left"
    )
    append_row(tmp_path / "results.jsonl", row)
    return config


def lines(config, labels=("strategy",), reference=None, goal=None, paper=()):
    groups = group(jobs_of(config), labels)
    return lines_of(groups, BOOTSTRAP, reference or {"strategy": "none"}, goal or {}, paper)


def test_jobs_are_those_of_hydras_sweeper(tmp_path):
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    params = {
        "seed": "0,1",
        "strategy.teacher": "{}, {a:1,b:{c:x}}",
        "budget.views": "range(5,8)",
        "name": "choice(p,q)",
    }
    given = ["seed=3", "ckpt='a b'", "+new=1", "data.image_size=[1,2]", "out=runs/x_${name}/y"]
    words = [f"{key}={value}" for key, value in params.items()]
    (expected,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides([*words, *given]), None)
    assert [list(job) for job in planned(sweep(tmp_path, params, *given))] == expected
    assert len(expected) == 2 * 3 * 2


def test_means_are_over_seeds_and_scenes_and_differences_are_paired(swept):
    none, sds, ngd = lines(swept)
    assert (none.name, sds.name, ngd.name) == ("none", "sds", "ngd")
    assert ngd.metrics["psnr"].mean == pytest.approx((21.0 + 26.0 + 22.0 + 25.0) / 4)
    per_scene = np.array([21.5 - 20.0, 25.5 - 24.0])
    assert ngd.differences["psnr"] == pytest.approx((1.5, 1.5, 1.5))  # both scenes gained as much
    assert ngd.metrics["psnr"][1:] == BOOTSTRAP(np.array([21.5, 25.5]))[1:]
    assert per_scene.mean() == ngd.differences["psnr"].mean
    assert not none.differences and "lpips" not in ngd.metrics
    assert ngd.metrics["fd_st_vgg"] == (170.0, 160.0, 180.0)
    assert ngd.metrics["distill_s"] == (4.5, 4.0, 5.0)
    assert (ngd.seeds, ngd.scenes, ngd.fallbacks, ngd.status) == (2, 2, 1, "ok")


def test_failed_and_missing_jobs_are_a_line(swept):
    sds = lines(swept)[1]
    assert (sds.status, sds.seeds, sds.metrics) == ("oom, not run", 0, {})
    assert sds.error == "no [bold] memory | left"


def test_the_newest_row_of_a_job_counts(swept, tmp_path):
    again = ["seed=0", "strategy=sds", "ckpt=demo"]
    write_job(tmp_path, again, "sds", 0, [10.0, 11.0])
    sds = lines(swept)[1]
    assert (sds.status, sds.metrics["psnr"].mean) == ("not run (1 of 2 jobs)", 10.5)
    assert len(read_rows(tmp_path / "results.jsonl")) == 6
    late = ResultRow(run_id="x", overrides=["seed=0", "strategy=none", "ckpt=other"], seed=0, strategy="none", psnr=1.0)
    append_row(tmp_path / "results.jsonl", late)  # of another command
    assert lines(swept)[0].metrics["psnr"].mean == 22


def test_the_share_of_the_frechet_gap(swept, tmp_path):
    none, _, ngd = lines(swept, goal={"strategy": "ngd"})
    assert ngd.closed == {"fd_st_vgg": 1.0} and none.closed == {}
    swept.hydra.sweeper.params.strategy = "none,ngd,cdm"
    for seed in (0, 1):
        overrides = [f"seed={seed}", "strategy=cdm", "ckpt=demo"]
        write_job(tmp_path, overrides, "cdm", seed, [19.0, 20.0], fd_st_vgg=100.0)
    ngd = lines(swept, goal={"strategy": "cdm"})[1]
    assert ngd.closed["fd_st_vgg"] == pytest.approx((300 - 170) / (300 - 100))


def test_jobs_that_came_to_the_same_are_one(tmp_path):
    """`none` has no virtual views: for any number of them its predictions are the same ones."""
    config = sweep(tmp_path, {"strategy": "none,ngd", "budget.views": "5,10", "seed": "0"})
    for views in (5, 10):
        write_job(tmp_path / str(views), ["strategy=ngd", f"budget.views={views}", "seed=0"], "ngd", views, [21, 22])
        write_job(tmp_path / str(views), ["strategy=none", f"budget.views={views}", "seed=0"], "none", 0, [20, 20])
    for part in ("5", "10"):
        for row in read_rows(tmp_path / part / "results.jsonl"):
            append_row(tmp_path / "results.jsonl", row)
    groups = group(jobs_of(config), ["strategy", "budget.views"])
    assert [g.labels for g in groups] == [
        {"strategy": "none"},
        {"strategy": "ngd", "budget.views": "5"},
        {"strategy": "ngd", "budget.views": "10"},
    ]
    assert counterpart(groups[2], groups, {"strategy": "none"}) is groups[0]
    assert counterpart(groups[2], groups, {}) is None


def test_a_reference_keeps_the_other_labels(tmp_path):
    config = sweep(tmp_path, {"cdm": "a,b", "strategy": "none,ngd"})
    groups = group(jobs_of(config), ["cdm", "strategy"])
    found = counterpart(groups[3], groups, {"strategy": "none"})
    assert (groups[3].name, found.name) == ("b ngd", "b none")


def test_what_else_the_command_sweeps_over_is_a_label(tmp_path):
    config = sweep(tmp_path, {"strategy": "none,ngd", "seed": "0,1"}, "budget.views=5,10", "ckpt=demo")
    assert [g.name for g in group(jobs_of(config), ["strategy"])] == ["none 5", "none 10", "ngd 5", "ngd 10"]


def test_paper_numbers_stand_beside_ours(swept):
    paper = [{"of": {"strategy": "ngd"}, "psnr": 23.51, "fid": 18.09}]
    found = lines(swept, paper=paper)
    assert found[2].paper == {"psnr": 23.51, "fid": 18.09} and found[0].paper == {}
    headings, _, *body = [line.strip("| ").split(" | ") for line in to_markdown(found).splitlines()[:5]]
    ngd = dict(zip(headings, body[2], strict=True))
    assert (ngd["paper: PSNR ↑"], ngd["paper: FID † ↓"]) == ("23.51", "18.09")
    assert ngd["PSNR ↑"].startswith("23.50 [21.50, 25.50") and ngd["Δ PSNR ↑"] == "+1.50 [+1.50, +1.50]"
    assert ngd["FD ST-VGG † ↓"] == "170.00 [160.00, 180.00]"


def test_csv_and_terminal_show_every_line(swept):
    found = lines(swept)
    rows = list(csv.DictReader(io.StringIO(to_csv(found))))
    assert [row["strategy"] for row in rows] == ["none", "sds", "ngd"]
    assert float(rows[2]["psnr"]) == 23.5 and float(rows[2]["psnr_difference"]) == 1.5
    assert float(rows[2]["fd_st_vgg_high"]) == 180 and rows[1]["psnr"] == ""
    assert (rows[1]["status"], rows[1]["error"]) == ("oom, not run", "no [bold] memory | left")
    console = Console(file=io.StringIO(), width=200)
    console.print(to_rich(found))
    assert "no [bold] memory | left" in console.file.getvalue()
    assert "no [bold] memory \\| left" in to_markdown(found)


@pytest.mark.parametrize("damage", ["", "many", "gone", "pipe", "outside"])
def test_damaged_scores_cost_their_intervals_and_no_other_line(swept, tmp_path, damage):
    path = tmp_path / "ngd-seed0" / "ngd-1234" / "scores" / "ngd" / "per_scene.csv"
    scores = path.read_text()
    path.unlink()
    if damage == "pipe":
        os.mkfifo(path)
    elif damage == "outside":
        (tmp_path.parent / f"{tmp_path.name}.csv").write_text(scores)
        path.symlink_to(tmp_path.parent / f"{tmp_path.name}.csv")
    elif damage != "gone":
        path.write_text(f"scene,views,blank,psnr\na,3,0,{damage}\0\n" if damage else scores)
    none, _, ngd = lines(swept)
    assert none.metrics["psnr"].mean == 22 and ngd.metrics["psnr"].mean == 23.5
    if damage:
        assert "per_scene.csv" in ngd.error and "without intervals over scenes" in ngd.error and not ngd.scenes
        assert ngd.metrics["psnr"] == (23.5, 23.5, 23.5) and not ngd.differences
    else:
        assert ngd.error is None and ngd.scenes == 2


def test_scores_that_are_no_numbers_stay_so(tmp_path):
    path = tmp_path / "per_scene.csv"
    path.write_text("scene,views,blank,psnr,ssim\na,3,0,nan,\n")
    assert math.isnan(read_scores(path)["a"]["psnr"]) and "ssim" not in read_scores(path)["a"]
    path.write_text("scene,psnr\n" + "a,1\n" * 2**19)
    with pytest.raises(DataError, match="bytes are too many"):
        read_scores(path)


@pytest.mark.parametrize("folder", ["../outside", "/tmp", "", None, "x\0y", "x" * 5000])
def test_a_job_has_nothing_outside_of_its_sweep(tmp_path, folder):
    (tmp_path / "outside" / "predictions" / "ngd").mkdir(parents=True)
    job = Job(("strategy=ngd",), ResultRow(run_id="x", strategy="ngd", folder=folder), tmp_path / "sweep")
    (tmp_path / "sweep").mkdir()
    with pytest.raises(DataError, match="is not there, or outside of the sweep's folder"):
        job.own("predictions")


def test_lines_that_are_no_rows_are_told_below_the_table(swept, tmp_path, capsys, monkeypatch):
    with open(tmp_path / "results.jsonl", "a") as file:
        file.write('{"torn\n[2]\n')
    monkeypatch.setattr(SweepTable, "_pictures", lambda *arguments: "none")
    callback = table()
    callback.on_multirun_start(swept)
    callback.on_multirun_end(OmegaConf.create())
    assert "2 lines are no rows and were skipped: line 6: not JSON" in (tmp_path / "table.md").read_text()
    assert "2 lines are no rows and were skipped" in " ".join(capsys.readouterr().out.split())
    assert len(list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))) == 3


@pytest.mark.parametrize(("error", "words"), [(DataError("no space"), "no space"), (KeyError("x"), "KeyError: 'x'")])
def test_a_sweep_that_wrote_no_table_fails(swept, monkeypatch, error, words):
    def write(*arguments):
        raise error

    monkeypatch.setattr(sweep_table, "write_text", write)
    callback = table()
    callback.on_multirun_start(swept)
    callback.on_job_end(swept, JobReturn(status=JobStatus.COMPLETED)) if isinstance(error, DataError) else None
    with pytest.raises(SystemExit, match=f"this sweep's table could not be written: {words}"):
        callback.on_multirun_end(OmegaConf.create())


def test_pictures_that_cannot_be_made_cost_no_table(swept, tmp_path, monkeypatch, caplog):
    def grid(*arguments):
        raise RuntimeError("no decoder")

    monkeypatch.setattr(sweep_grid, "grid", grid)
    callback = table()
    callback.on_multirun_start(swept)
    callback.on_multirun_end(OmegaConf.create())
    assert "no decoder" in caplog.text and (tmp_path / "table.md").is_file()


def test_what_rows_say_is_text_everywhere(swept, tmp_path):
    words = "[/bold] `x` <img src=x> [a](javascript:x) ${1} \x1b[2J a\nb | *c*"
    overrides = ["seed=1", "strategy=sds", "ckpt=demo"]
    append_row(tmp_path / "results.jsonl", ResultRow(run_id="x", overrides=overrides, status="error", error=words))
    found = lines(swept)
    console = Console(file=io.StringIO(), width=300)
    console.print(to_rich(found))
    assert "[/bold] `x` <img src=x> [a](javascript:x) ${1}  [2J a b | *c*" in console.file.getvalue()
    text = to_markdown(found)
    assert "[/bold] \\`x\\` &lt;img src=x> [a]\\(javascript:x) ${1}  [2J a b \\| \\*c\\*" in text and "\x1b" not in text


def table(frontier=None, pause=0.0):
    return SweepTable(["strategy"], {"strategy": "none"}, {}, [], BOOTSTRAP, frontier, pause, True)


def test_a_failure_that_no_row_tells_of_becomes_one(tmp_path, monkeypatch):
    overrides = ["strategy=none", "seed=0"]

    def record(cfg, error, subject, strategy):  # the real one asks Hydra for the job that has just ended
        row = ResultRow(run_id="x", overrides=overrides, strategy="none", seed=0, status="error", error=str(error))
        append_row(cfg.results, row)

    monkeypatch.setattr(measure, "record_failure", record)
    config = sweep(tmp_path, {"strategy": "none", "seed": "0"})
    callback = table()
    callback.on_multirun_start(config)
    job = OmegaConf.merge(config, {"results": str(tmp_path / "results.jsonl"), "run_name": "x", "seed": 0})
    job = OmegaConf.merge(job, {"strategy": {"name": "none"}, "hydra": {"overrides": {"task": overrides}}})
    failed = JobReturn(overrides=overrides, status=JobStatus.FAILED, _return_value=OSError("disk full"))
    callback.on_job_end(job, failed)
    assert failed.status == JobStatus.COMPLETED  # Hydra would end the sweep at a failed one
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert (row.status, row.error) == ("error", "disk full")
    assert "disk full" in (tmp_path / "table.md").read_text()


def test_a_sweep_without_any_success_says_so_and_fails(tmp_path):
    callback = table()
    callback.on_multirun_start(sweep(tmp_path, {"strategy": "none", "seed": "0"}))
    with pytest.raises(SystemExit, match="no job of this sweep succeeded"):
        callback.on_multirun_end(OmegaConf.create())
    assert "not run" in (tmp_path / "table.md").read_text() and not (tmp_path / "grid.png").exists()


def test_the_frontier_is_of_one_device_and_of_each_quality(tmp_path):
    seconds = {"none": 1.0, "sds": 2.0, "ngd": 3.0, "ngd_current": 4.0, "cdm": 5.0}
    psnr = {"none": 20.0, "sds": 19.0, "ngd": 21.0, "ngd_current": 20.5, "cdm": 18.0}
    config = sweep(tmp_path, {"strategy": ",".join(seconds), "seed": "0"})
    for strategy, value in psnr.items():
        write_job(
            tmp_path,
            [f"strategy={strategy}", "seed=0"],
            strategy,
            0,
            [value, value],
            fd_st_vgg=100.0 - 10 * seconds[strategy],
            scene_s={"n": 1, "median": seconds[strategy], "iqr": 0.0},
            device="cpu" if strategy != "cdm" else "GPU",
        )
    groups = group(jobs_of(config), ["strategy"])
    found = lines_of(groups, BOOTSTRAP, {}, {}, [])
    marked = Frontier("scene_s", ["psnr", "fd_st_vgg", "fid"])(groups, found)
    assert {line.name: line.frontier for line in marked} == {
        "none": ("psnr", "fd_st_vgg"),
        "sds": ("fd_st_vgg",),  # another pays less for more PSNR
        "ngd": ("psnr", "fd_st_vgg"),
        "ngd_current": ("fd_st_vgg",),
        "cdm": ("psnr", "fd_st_vgg"),  # the only one of its device
    }
    rows = list(csv.DictReader(io.StringIO(to_csv(marked))))
    assert rows[1]["frontier"] == "fd_st_vgg" and "| PSNR, FD ST-VGG |" in to_markdown(marked)
    with pytest.raises(ConfigError, match="psnrr is no metric; choose psnr"):
        Frontier("scene_s", ["psnrr"])


def test_terminal_and_pictures_show_the_frontier(swept, tmp_path, monkeypatch, capsys):
    seconds = {"n": 2, "median": 9.0, "iqr": 0.0}
    for seed in (0, 1):  # costs more than ngd for less
        overrides = [f"seed={seed}", "strategy=sds", "ckpt=demo"]
        write_job(tmp_path, overrides, "sds", seed, [20.0, 20.0], distill_s=seconds)
    shown = []
    for module, name in ((sweep_grid, "grid"), (sweep_orbits, "orbits")):
        monkeypatch.setattr(module, name, lambda *arguments: shown.extend(arguments) and None)
    callback = table(Frontier("distill_s", ["psnr"]))
    callback.on_multirun_start(OmegaConf.merge(swept, {"orbit": {}}))
    callback.on_multirun_end(OmegaConf.create())
    pictured = [[g.name for g in groups] for groups in shown if isinstance(groups, list)]
    assert pictured == [["ngd"], ["ngd"]]
    printed = capsys.readouterr().out
    assert "ngd" in printed and "sds" not in printed
    assert "sds" in (tmp_path / "table.md").read_text()


def test_the_table_is_written_at_most_so_often_while_the_sweep_runs(swept, tmp_path):
    callback = table(pause=3600.0)
    callback.on_multirun_start(swept)
    done = JobReturn(status=JobStatus.COMPLETED)
    callback.on_job_end(swept, done)
    first = (tmp_path / "table.csv").stat().st_mtime_ns
    callback.on_job_end(swept, done)
    assert (tmp_path / "table.csv").stat().st_mtime_ns == first
    table(pause=0.0).on_job_end(swept, done)  # a job by itself is no sweep
    assert (tmp_path / "table.csv").stat().st_mtime_ns == first
    callback.pause = 0.0
    callback.on_job_end(swept, done)
    assert (tmp_path / "table.csv").stat().st_mtime_ns > first
