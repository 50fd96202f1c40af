"""The sweep as a command, on launchers that run jobs side by side."""

import os
import subprocess
import sys

import pytest

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


def test_what_cannot_be_swept_over_ends_in_one_line(tmp_path):
    for override, words in (
        ("hydra.sweeper.minutes=0", "minutes=0 must be more than 0"),
        ("seed=interval(0,1)", "seed"),
    ):
        command = [sys.executable, str(SRC / "distill.py"), "sweep=speed_accuracy", "ckpt=demo", override]
        command.append(f"hydra.sweep.dir={tmp_path}")
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=120)
        assert done.returncode == 1 and words in done.stderr and "Traceback" not in done.stderr, done.stderr
