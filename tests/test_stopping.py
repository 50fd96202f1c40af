"""Runs that are stopped, killed, diverge, or are begun twice: what was done is kept, and what is said is true."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from lightning import Callback

from nerfdiff.checkpoint import last_checkpoint as checkpoint_to_resume
from nerfdiff.checkpoint import load_model
from nerfdiff.cli import entry_point, load_config
from nerfdiff.stopping import SIGNALS, Stopped, in_a_job, on_signals
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.training.run import build_trainer
from nerfdiff.utils.errors import BusyError, CheckpointError, TrainingDiverged
from nerfdiff.utils.files import held
from training_fixtures import (
    assert_same_state,
    command,
    environment,
    last_checkpoint,
    overrides,
    run_training,
    train_with,
    write_dataset,
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def begun(data, tmp_path_factory):
    """A run of two steps, to be copied."""
    run = tmp_path_factory.mktemp("begun") / "run"
    run_training(data, run, "trainer.max_steps=2", "callbacks.last.every_n_steps=1", "optimizer.decay=none")
    return run


@pytest.fixture
def run(begun, tmp_path):
    return shutil.copytree(begun, tmp_path / "run")


class Signal(Callback):
    """Sends this process a signal at the end of a training or validation batch, as a person or a scheduler would."""

    def __init__(self, *signums: int, batch: int | None = None, validation_batch: int | None = None):
        self.signums, self.batch, self.validation_batch = signums, batch, validation_batch

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if batch_idx == self.batch:
            self.send()

    def on_validation_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if batch_idx == self.validation_batch:
            self.send()

    def send(self):
        for signum in self.signums:
            os.kill(os.getpid(), signum)


@pytest.mark.parametrize(
    ("signums", "accumulate", "batch"),
    [((signal.SIGTERM, signal.SIGUSR1), 1, 0), ((signal.SIGINT,), 2, 4), ((signal.SIGUSR2,), 2, 5)],
)
def test_a_stopped_run_ends_its_step_and_goes_on_as_if_nothing_happened(
    data, tmp_path, monkeypatch, signums, accumulate, batch
):
    """Stopped in the first step, and of windows of two batches within one (batch 4) and at its end (batch 5).

    Slurm sends SIGTERM and what it was asked for at once, and the latter counts.
    """
    more = [f"trainer.accumulate_grad_batches={accumulate}", "callbacks.last.every_n_steps=1000"]
    run_training(data, tmp_path / "whole", *more)
    with pytest.raises(Stopped) as stopped:
        train_with(monkeypatch, Signal(*signums, batch=batch), data, tmp_path / "stopped", *more)
    step = -(-(batch + 1) // accumulate)
    assert stopped.value.status == 128 + signums[-1]
    assert last_checkpoint(tmp_path / "stopped")["global_step"] == step
    assert f"Step {step} is saved in {tmp_path / 'stopped' / 'checkpoints' / 'last.ckpt'}" in str(stopped.value)
    run_training(data, tmp_path / "stopped", *more)
    assert_same_state(last_checkpoint(tmp_path / "whole"), last_checkpoint(tmp_path / "stopped"))


def test_a_run_stopped_in_a_validation_validates_anew(data, tmp_path, monkeypatch):
    more = ["callbacks.last.every_n_steps=1000", "trainer.max_steps=4"]
    whole = run_training(data, tmp_path / "whole", *more)
    with pytest.raises(Stopped, match="Step 3 is saved"):
        train_with(monkeypatch, Signal(signal.SIGTERM, validation_batch=1), data, tmp_path / "stopped", *more)
    assert not list((tmp_path / "stopped").glob("previews/*"))
    resumed = run_training(data, tmp_path / "stopped", *more)
    assert_same_state(last_checkpoint(tmp_path / "whole"), last_checkpoint(tmp_path / "stopped"))
    assert resumed["val/psnr"] == whole["val/psnr"]
    best = [torch.load(tmp_path / r / "checkpoints/best.ckpt", weights_only=True) for r in ("whole", "stopped")]
    assert best[0]["global_step"] == best[1]["global_step"] == 3


def test_a_second_signal_ends_the_run_at_once(data, run, monkeypatch):
    with pytest.raises(Stopped, match="Step 2 is saved"):
        train_with(
            monkeypatch, Signal(signal.SIGINT, signal.SIGINT, batch=4), data, run, "callbacks.last.every_n_steps=1000"
        )
    assert last_checkpoint(run)["global_step"] == 2


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_command_that_is_stopped_says_so_in_one_line(signum, monkeypatch, tmp_path, capsys):
    words = ["hydra/job_logging=none", "hydra/hydra_logging=none", "hydra.output_subdir=null"]
    monkeypatch.setattr(sys, "argv", ["src/evaluate.py", *words, f"hydra.run.dir={tmp_path}/a b"])

    def work(cfg):
        try:
            os.kill(os.getpid(), signum)
            time.sleep(1)
        except Stopped as stopped:
            raise Stopped(stopped.signum, "Step 7 is saved in x.") from None

    before = [signal.getsignal(number) for number in SIGNALS]
    with pytest.raises(SystemExit) as end:
        entry_point("evaluate")(work)()
    assert end.value.code == 128 + signum
    name = "Ctrl-C" if signum == signal.SIGINT else signal.Signals(signum).name
    (line,) = capsys.readouterr().err.splitlines()
    arguments = " ".join(words)
    assert line == (
        f"stopped by {name}. Step 7 is saved in x. To go on: python src/evaluate.py {arguments} "
        f"'hydra.run.dir={tmp_path}/a b'"
    )
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_a_signal_that_is_ignored_stays_so():
    """As SIGHUP is under nohup, and SIGINT in a script's background."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with on_signals(pytest.fail):
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def wait_for_log(run, words: str, process) -> None:
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline and process.poll() is None:
        if any(words in path.read_text() for path in run.glob("*.log")):
            return
        time.sleep(0.05)
    process.kill()
    pytest.fail(process.communicate()[1])


def test_ctrl_c_reaches_a_run_and_its_workers(data, tmp_path):
    """As from a terminal, to all processes of the group: loaders of data leave the step what it needs."""
    steps = [
        "trainer.max_steps=2000",
        "validation_every=10000",
        "data.num_workers=2",
        "callbacks.last.every_n_steps=1000",
    ]
    run = tmp_path / "run"
    process = subprocess.Popen(
        command(
            data,
            run,
            *steps,
            "callbacks.progress={_target_: nerfdiff.training.callbacks.progress.TrainingProgress, "
            "every_steps: 1, every_seconds: 60}",
        ),
        env=environment(),
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_for_log(run, "step 2 of 2000", process)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130, said
    step = last_checkpoint(run)["global_step"]
    last = said.strip().splitlines()[-1]
    assert last.startswith(f"stopped by Ctrl-C. Step {step} is saved in ") and "To go on: python " in last
    assert "Traceback" not in said


def test_a_run_does_not_go_on_with_other_data(data, run, tmp_path, caplog):
    """The record of the run that is there stays; asked for, it goes on."""
    other = write_dataset(tmp_path / "other")
    record = (run / "config.yaml").read_bytes()
    with pytest.raises(CheckpointError, match=re.escape(f"trained on data.root={data}, and data.root is {other} now")):
        run_training(other, run)
    assert (run / "config.yaml").read_bytes() == record and last_checkpoint(run)["global_step"] == 2
    run_training(other, run, "other_data=true", "trainer.max_steps=3")
    assert last_checkpoint(run)["global_step"] == 3
    with pytest.raises(CheckpointError, match=r"trained on data\.root="):
        run_training(data, run)


@pytest.mark.parametrize("changed", ["an image", "the framing", "a scene"])
def test_data_that_changed_are_other_data(changed, data, begun, tmp_path):
    run = shutil.copytree(begun, tmp_path / "run")
    root = shutil.move(shutil.copytree(data, tmp_path / "copied", copy_function=shutil.copy2), tmp_path / "moved")
    run_training(root, run, "trainer.max_steps=3", f"data.cache_dir={tmp_path}")  # only moved: the same
    image = root / "cars_train" / "scene0" / "rgb" / "000000.png"
    more = []
    if changed == "an image":
        shutil.copy(image.with_name("000001.png"), image)
    elif changed == "a scene":
        shutil.rmtree(root / "cars_train" / "scene2")
    else:
        more = ["data.image_size=[12,14]"]
    words = "read as" if changed == "the framing" else "files there were added, removed or changed since"
    with pytest.raises(CheckpointError, match=words):
        run_training(root, run, f"data.cache_dir={tmp_path}", *more)


def test_a_run_from_before_its_data_was_recorded_goes_on(data, run, caplog):
    path = run / "checkpoints" / "last.ckpt"
    checkpoint = last_checkpoint(run)
    del checkpoint["SceneDataModule"]
    torch.save(checkpoint, path)
    run_training(data, run, "trainer.max_steps=3")
    assert "does not say what data it was trained on" in caplog.text


def diverge(monkeypatch, at: int, factor: float = float("nan")) -> None:
    """Losses times `factor` from a step on."""
    step = NerfDiffModule.training_step

    def training_step(self, batch, batch_idx):
        return step(self, batch, batch_idx) * (factor if self.trainer.global_step >= at else 1.0)

    monkeypatch.setattr(NerfDiffModule, "training_step", training_step)


EVERY_STEP = [
    "callbacks.last.every_n_steps=1",
    "callbacks.nonfinite.patience=3",
    "optimizer.decay=none",
]


def test_a_diverging_run_keeps_the_checkpoint_from_before(data, run, monkeypatch):
    """Steps 3 and 4 are good. 4's weights are the ones that no good step followed."""
    diverge(monkeypatch, at=4)
    with pytest.raises(TrainingDiverged, match=r"3 steps in a row.* Step 3 is saved in .*last\.ckpt"):
        run_training(data, run, *EVERY_STEP, "validation_every=2", "trainer.max_steps=20")
    assert last_checkpoint(run)["global_step"] == 3
    folder = run / "checkpoints"
    assert torch.load(folder / "diverged.ckpt", weights_only=True)["global_step"] == 4
    assert torch.load(folder / "best.ckpt", weights_only=True)["global_step"] <= 4
    monkeypatch.undo()
    run_training(data, run, *EVERY_STEP, "trainer.max_steps=5")
    assert last_checkpoint(run)["global_step"] == 5


def test_trying_again_what_goes_wrong_at_once_costs_no_checkpoint(data, run, monkeypatch):
    """Steps 2 and 1 are there, and sound; as where the data or the GPU is broken and a scheduler starts anew."""
    diverge(monkeypatch, at=0)
    for _ in range(3):
        with pytest.raises(TrainingDiverged, match=r"Step 1 is saved in .*last\.ckpt"):
            run_training(data, run, *EVERY_STEP, "trainer.max_steps=20")
    steps = {p.name: torch.load(p, weights_only=True)["global_step"] for p in (run / "checkpoints").glob("*.ckpt")}
    assert steps["last.ckpt"] == 1 and steps["diverged.ckpt"] == 2


def test_a_run_that_never_was_well_says_so(data, tmp_path, monkeypatch):
    diverge(monkeypatch, at=1)
    with pytest.raises(TrainingDiverged, match="No checkpoint is from before that: start afresh"):
        run_training(data, tmp_path, *EVERY_STEP)
    assert not (tmp_path / "checkpoints" / "last.ckpt").exists()


def test_a_run_whose_losses_jump_saves_nothing_until_they_calm_down(data, run, monkeypatch):
    """Far before anything is not finite; and no step that is stopped then replaces a good one."""
    diverge(monkeypatch, at=3, factor=1e6)
    with pytest.raises(Stopped, match="Step 3 is saved"):
        train_with(monkeypatch, Signal(signal.SIGTERM, batch=7), data, run, *EVERY_STEP, "trainer.max_steps=20")
    assert last_checkpoint(run)["global_step"] == 3


def test_a_checkpoint_that_cannot_be_read_is_passed_over(data, run, caplog):
    """What a power cut may leave of the last one; the one before holds the step before."""
    folder = run / "checkpoints"
    (folder / "last.ckpt").write_bytes(b"")
    run_training(data, run, "trainer.max_steps=2", "callbacks.last.every_n_steps=1", "optimizer.decay=none")
    assert caplog.text.count("last.ckpt is not a readable checkpoint") == 1
    assert last_checkpoint(run)["global_step"] == 2
    assert torch.load(folder / "previous.ckpt", weights_only=True)["global_step"] == 1  # never the damaged one


def test_a_checkpoint_that_is_missing_is_passed_over(run):
    (run / "checkpoints" / "last.ckpt").unlink()
    assert checkpoint_to_resume(run).name == "previous.ckpt"


def test_a_last_checkpoint_of_another_version_is_taken_where_it_is_the_newer(data, run, tmp_path):
    """As Lightning leaves it where it is not to replace a file; a damaged one is passed over."""
    folder = run / "checkpoints"
    shutil.copy(folder / "last.ckpt", folder / "last-v1.ckpt")
    shutil.copy(folder / "previous.ckpt", folder / "last.ckpt")  # of step 1
    os.utime(folder / "last-v1.ckpt", (0, 0))  # times are copied, or not
    assert checkpoint_to_resume(run).name == "last-v1.ckpt"
    assert load_model(run, "ema").path.name == "last-v1.ckpt"
    (folder / "last-v2.ckpt").write_bytes(b"torn")
    run_training(data, run, "trainer.max_steps=3", "callbacks.last.every_n_steps=1", "optimizer.decay=none")
    assert checkpoint_to_resume(run).name == "last.ckpt" and last_checkpoint(run)["global_step"] == 3
    (folder / "last.ckpt").unlink()
    (folder / "previous.ckpt").unlink()
    assert checkpoint_to_resume(run).name == "last-v1.ckpt"


@pytest.fixture
def scontrol(tmp_path, monkeypatch):
    """A fake of Slurm's command; what it was asked."""
    (tmp_path / "bin").mkdir()
    command, told = tmp_path / "bin" / "scontrol", tmp_path / "told"
    command.write_text(
        f'#!/bin/sh\necho "$@" >> {told}\n[ $1 = requeue ] || echo "JobId=7 PreemptTime=$PREEMPT_TIME"\n'
    )
    command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{command.parent}:{os.environ['PATH']}")
    return lambda: told.read_text().splitlines() if told.exists() else []


@pytest.mark.parametrize(
    ("signum", "environ", "asked"),
    [
        (signal.SIGUSR1, {"SLURM_JOB_ID": "7"}, ["requeue 7"]),
        (
            signal.SIGUSR1,
            {"SLURM_JOB_ID": "9", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"},
            ["requeue 7_3"],
        ),
        (signal.SIGTERM, {"SLURM_JOB_ID": "7", "PREEMPT_TIME": "2026-11-28T10:00:00"}, ["show job 7", "requeue 7"]),
        (signal.SIGTERM, {"SLURM_JOB_ID": "7", "PREEMPT_TIME": "None"}, ["show job 7"]),  # scancel
        (signal.SIGINT, {"SLURM_JOB_ID": "7"}, []),
        (signal.SIGUSR1, {}, []),
    ],
)
@pytest.mark.parametrize("rank", [0, 1])
def test_a_job_that_is_to_give_way_is_queued_again_once(signum, environ, asked, rank, scontrol, monkeypatch):
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("nerfdiff.utils.rank._known", [rank])
    with pytest.raises(Stopped), in_a_job():
        raise Stopped(signum)
    assert [words for words in scontrol() if rank == 0 or "requeue" in words] == (asked if rank == 0 else [])


def test_submitits_jobs_are_queued_again_by_submitit_alone(scontrol, monkeypatch):
    """Whose handler ends the process; SIGTERM alone, which it lets pass by, stops the work too."""
    for name, value in {"SUBMITIT_EXECUTOR": "slurm", "SLURM_JOB_ID": "7", "PREEMPT_TIME": "None"}.items():
        monkeypatch.setenv(name, value)
    called = []

    def requeue(signum, frame):
        called.append(signum)
        sys.exit(-1)

    def job(signum):
        with in_a_job():
            os.kill(os.getpid(), signum)
            time.sleep(1)

    before = [signal.signal(signal.SIGUSR2, requeue), signal.signal(signal.SIGTERM, signal.SIG_IGN)]
    try:
        signal.signal(signal.SIGTERM, lambda *_: called.append("passed by"))
        with pytest.raises(SystemExit):
            job(signal.SIGUSR2)
        with pytest.raises(Stopped):
            job(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGUSR2, before[0])
        signal.signal(signal.SIGTERM, before[1])
    assert called == [signal.SIGUSR2] and scontrol() == ["show job 7"]


def test_under_slurm_lightning_queues_nothing_and_takes_no_strangers_checkpoint(data, run, monkeypatch):
    """A checkpoint that Lightning writes on a scheduler's signal is of whatever run the folder's last job was."""
    for name, value in {"NTASKS": "1", "PROCID": "0", "LOCALID": "0", "NODEID": "0", "JOB_ID": "7"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    monkeypatch.setenv("SLURM_JOB_NAME", "train")
    cfg = load_config("train", overrides(data, run, f"paths.output_dir={run}"))
    trainer = build_trainer(cfg)
    environment = trainer._accelerator_connector.cluster_environment
    assert type(environment).__name__ == "SLURMEnvironment" and not environment.auto_requeue
    assert trainer.default_root_dir == str(run)


def test_two_commands_do_not_write_one_run(data, run):
    record = (run / "config.yaml").read_bytes()
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            f"import time; from nerfdiff.utils.files import held; from pathlib import Path\n"
            f"with held(Path({str(run)!r})): print('held', flush=True); time.sleep(60)",
        ],
        stdout=subprocess.PIPE,
        text=True,
        env=environment() | {"PYTHONPATH": "src"},
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(BusyError, match=f"process {holder.pid} on {os.uname().nodename} is working in {run}"):
        run_training(data, run, "seed=3")
    assert (run / "config.yaml").read_bytes() == record
    holder.kill()
    holder.wait()
    with held(run):  # a killed process holds nothing
        pass
