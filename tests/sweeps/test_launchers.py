"""The sweep as a command, on launchers that run jobs side by side."""

import os
import subprocess
import sys
import time

import pytest

from fake_slurm import jobs, slurm
from nerfdiff.cli import CONF
from nerfdiff.results.row import read_rows
from training_fixtures import SRC, environment

SCRIPT = """
import os
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from nerfdiff.cli import entry_point
from nerfdiff.results.row import ResultRow, append_row


@entry_point("distill")
def main(cfg):
    deaths = Path(cfg.results).parent / "deaths"
    if cfg.uniform_samples == 6 and cfg.seed == 0 and deaths.is_dir() and len(list(deaths.iterdir())) < 2:
        (deaths / str(os.getpid())).touch()
        os._exit(3)
    row = ResultRow(
        run_id=str(os.getpid()),
        overrides=list(HydraConfig.get().overrides.task),
        seed=cfg.seed,
        strategy=cfg.strategy.name,
        dataset="cars",
        device="cpu",
        psnr=20.0 + cfg.uniform_samples,
        scene_s={"n": 1, "median": 1.0 * cfg.uniform_samples, "iqr": 0.0},
    )
    append_row(cfg.results, row)


main()
"""


def run(folder, launcher, *more):
    (folder / "command.py").write_text(SCRIPT)
    command = [
        sys.executable, str(folder / "command.py"), "sweep=speed_accuracy", "ckpt=demo", "budget=minutes",
        "strategy=none", "precision=32-true", "backend=torch", "importance_samples=6", "seed=0,1",
        f"hydra.sweep.dir={folder}", f"hydra/launcher={launcher}", "~hydra.callbacks.table", *more,
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=300)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


def test_a_worker_of_joblib_that_is_killed_costs_its_own_job_alone(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="pip install hydra-joblib-launcher")
    (tmp_path / "deaths").mkdir()  # one in the batch, one by itself
    told = run(tmp_path, "joblib", "hydra.launcher.n_jobs=2", "uniform_samples=6,12")
    rows = read_rows(tmp_path / "results.jsonl")
    assert len(rows) == len({tuple(row.overrides) for row in rows}) == 4
    lost = [row for row in rows if row.status != "ok"]
    assert [(row.status, row.seed, "uniform_samples=6" in row.overrides) for row in lost] == [("error", 0, True)]
    assert "terminated" in lost[0].error and "4 jobs of this sweep: 3 ok, 1 error" in told
    assert str(os.getpid()) not in {row.run_id for row in rows}
    page = tmp_path / "chart" / "index.html"
    assert page.is_file() and str(page) in told

    told = run(tmp_path, "basic", "uniform_samples=6,12", "~hydra.callbacks.chart")  # goes on with another launcher
    (again,) = read_rows(tmp_path / "results.jsonl")[4:]
    assert again.status == "ok" and again.overrides == lost[0].overrides and "4 ok" in told


def test_submitit_runs_every_job_in_a_process_of_its_own(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="pip install hydra-submitit-launcher")
    told = run(tmp_path, "submitit_local", "uniform_samples=12", "~hydra.callbacks.chart")
    rows = read_rows(tmp_path / "results.jsonl")
    assert [row.status for row in rows] == ["ok"] * 2 and "2 ok" in told
    assert len({row.run_id for row in rows}) == 2


LIGHT = """
import os, sys, time

import hydra
from hydra.core.hydra_config import HydraConfig
from submitit import SlurmJob

from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.stopping import in_a_job

SlurmJob.watcher._delay_s, SlurmJob._results_timeout_s = 0.5, 0.5


@hydra.main(version_base="1.3", config_path=".", config_name="light")
def main(cfg):
    with in_a_job():
        if os.environ.get("FAKE_SLURM_SLOW"):
            time.sleep(60)
        words = list(HydraConfig.get().overrides.task)
        append_row(cfg.results, ResultRow(run_id=str(os.getpid()), overrides=words, seed=cfg.x))


main()
"""
LIGHT_CONFIG = """
defaults:
  - _self_
  - override hydra/sweeper: budgeted
  - override hydra/sweeper/proposals: grid
  - override hydra/launcher: submitit_slurm
  - override hydra/job_logging: none
x: 0
results: ${hydra:sweep.dir}/results.jsonl
hydra:
  searchpath: ["file://CONF"]
  output_subdir: null
  mode: MULTIRUN
  launcher: {max_num_timeout: 3}
  sweeper: {batch_size: null}
"""


PRELOADED = (
    *("numpy", "submitit.core._submit", "hydra", "hydra_plugins.hydra_submitit_launcher.submitit_launcher"),
    *("hydra_plugins.nerfdiff_sweeper", "nerfdiff.sweeps.task", "nerfdiff.results.row", "nerfdiff.stopping"),
)


def array(folder, count, policy, parallel=4):
    """The rows of a sweep of so many jobs on a Slurm that deals with them by `policy`; its commands' words."""
    sweep, cluster = folder / "sweep", folder / "slurm"
    (folder / "light.py").write_text(LIGHT)
    (folder / "light.yaml").write_text(LIGHT_CONFIG.replace("CONF", str(CONF)))
    sweep.mkdir()
    command = [sys.executable, str(folder / "light.py"), f"x=range({count})", f"hydra.sweep.dir={sweep}"]
    with slurm(cluster, policy, PRELOADED, parallel) as environ:
        done = subprocess.run(command, capture_output=True, text=True, env=environ, cwd=folder, timeout=3000)
    words = done.stdout + done.stderr + (cluster / "control.log").read_text()
    assert done.returncode == 0, words[-4000:]
    return read_rows(sweep / "results.jsonl"), jobs(cluster), (cluster / "scontrol.log").read_text().splitlines()


def test_of_an_array_of_which_jobs_die_every_result_is_there_once(tmp_path):
    """Killed at the start, or when all was done but telling it; out of time; to give way: queued again, once."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="pip install hydra-submitit-launcher")
    policy = {"killed": [0, 7], "killed_late": [3], "timeout": [9], "preempted": [5, 11]}
    rows, ran, asked = array(tmp_path, 14, policy)
    assert sorted(row.seed for row in rows) == list(range(14)) and {row.status for row in rows} == {"ok"}
    assert sorted(line for line in asked if line.startswith("requeue")) == ["requeue 100_11", "requeue 100_5"]
    assert {name: job["tries"] for name, job in ran.items() if job["tries"] > 1} == {"100_5": 2, "100_11": 2}
    assert ran["100_9"]["state"] == "TIMEOUT" and ran["100_3"]["state"] == "FAILED"
    assert sorted(name for name in ran if name.startswith("101")) == ["101_0", "101_1", "101_2"]  # 0, 7 and 9, again


@pytest.mark.faults
def test_an_array_of_a_thousand_jobs_of_which_one_in_twenty_dies(tmp_path):
    """Prints how long it took, for docs/scale.md."""
    dying = list(range(3, 1000, 20))
    policy = {"killed": dying[::4], "killed_late": dying[1::4], "timeout": dying[2::4], "preempted": dying[3::4]}
    begun = time.monotonic()
    rows, ran, _ = array(tmp_path, 1000, policy)
    again = sum(name.startswith("101") for name in ran)
    print(f"1000 jobs, {len(dying)} in trouble, {again} run again: {len(rows)} rows, {time.monotonic() - begun:.0f} s")
    assert sorted(row.seed for row in rows) == list(range(1000))


def test_what_cannot_be_swept_over_ends_in_one_line(tmp_path):
    for override, words in (
        ("hydra.sweeper.minutes=0", "minutes=0 must be more than 0"),
        ("seed=interval(0,1)", "seed"),
    ):
        command = [sys.executable, str(SRC / "distill.py"), "sweep=speed_accuracy", "ckpt=demo", override]
        command.append(f"hydra.sweep.dir={tmp_path}")
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=120)
        assert done.returncode == 1 and words in done.stderr and "Traceback" not in done.stderr, done.stderr
