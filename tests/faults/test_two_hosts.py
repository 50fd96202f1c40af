"""Training on two hosts, network namespaces of this machine, two ranks each over gloo: `make faults`, as root."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import torch

from fake_slurm import FINAL, jobs, send, slurm
from nerfdiff.checkpoint import steps_of
from training_fixtures import (
    SRC,
    assert_same_state,
    environment,
    last_checkpoint,
    overrides,
    run_training,
    write_dataset,
)

pytestmark = pytest.mark.faults
HOSTS = ("nerfdiff1", "nerfdiff2")
STEPS = ["trainer.max_steps=40", "callbacks.last.every_n_steps=5", "validation_every=20", "callbacks.previews=null"]
MINUTE = 60.0


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def two_hosts():
    """Two namespaces with one link between."""
    if os.geteuid() or not shutil.which("ip") or subprocess.run(["ip", "netns", "add", HOSTS[0]]).returncode:
        pytest.skip("network namespaces need root, and the command ip")
    try:
        ip("netns", "add", HOSTS[1])
        ip("link", "add", "cable0", "netns", HOSTS[0], "type", "veth", "peer", "name", "cable0", "netns", HOSTS[1])
        for number, host in enumerate(HOSTS, 1):
            ip("-n", host, "addr", "add", f"10.77.0.{number}/24", "dev", "cable0")
            for device in ("lo", "cable0"):
                ip("-n", host, "link", "set", device, "up")
        yield
    finally:
        for host in HOSTS:
            subprocess.run(["ip", "netns", "del", host], capture_output=True)


class Launched:
    """The command on both hosts, by torchrun, as docs/scale.md says."""

    def __init__(self, data: Path, run: Path, port: int):
        words = overrides(data, run, *STEPS, "trainer=ddp", "trainer.accelerator=cpu", "trainer.precision=32-true")
        words += ["trainer.num_nodes=2", "trainer.devices=2"]
        self.processes = []
        self.said = [run.parent / f"{run.name}-{port}-{host}.log" for host in HOSTS]
        for number, (host, said) in enumerate(zip(HOSTS, self.said, strict=True)):
            command = [
                *("ip", "netns", "exec", host, sys.executable, "-m", "torch.distributed.run", "--nnodes=2"),
                *("--nproc-per-node=2", f"--node-rank={number}", "--master-addr=10.77.0.1", f"--master-port={port}"),
                *(str(SRC / "train.py"), *words),
            ]
            environ = environment() | {"GLOO_SOCKET_IFNAME": "cable0", "PYTHONPATH": str(SRC)}
            with open(said, "w") as log:
                self.processes.append(
                    subprocess.Popen(command, env=environ, stdout=log, stderr=log, start_new_session=True)
                )

    def ranks(self, host: int) -> list[psutil.Process]:
        below = psutil.Process(self.processes[host].pid).children(recursive=True)
        return [process for process in below if "torch.distributed.run" not in process.cmdline()]

    def wait(self, seconds: float) -> list[int]:
        until = time.monotonic() + seconds
        while any(process.poll() is None for process in self.processes):
            assert time.monotonic() < until, self.words()
            time.sleep(0.1)
        return [process.returncode for process in self.processes]

    def words(self) -> str:
        return "\n".join(said.read_text()[-6000:] for said in self.said)

    def kill(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait_for_step(run: Path, step: int, launched: Launched) -> None:
    until = time.monotonic() + 1500
    while (steps_of(run / "checkpoints" / "last.ckpt") or 0) < step:
        assert all(process.poll() is None for process in launched.processes), launched.words()
        assert time.monotonic() < until
        time.sleep(0.2)


def distance(one: dict, other: dict) -> float:
    """Of two models' weights, as a share of their norm."""
    difference, norm = (
        torch.cat([value.flatten() for value in values]).norm()
        for values in ([one[name] - value for name, value in other.items()], one.values())
    )
    return float(difference / norm)


def sent() -> int:
    """Bytes that left the first host."""
    path = "/sys/class/net/cable0/statistics/tx_bytes"
    return int(subprocess.run(["ip", "netns", "exec", HOSTS[0], "cat", path], capture_output=True, text=True).stdout)


def test_two_hosts_train_what_one_process_does_and_go_on_after_a_death_and_a_cut(tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    alone = tmp_path / "alone"
    run_training(data, alone, *STEPS)
    with two_hosts():
        whole, broken, port = tmp_path / "whole", tmp_path / "broken", 29600
        before = sent()
        launched = Launched(data, whole, port)
        try:
            assert launched.wait(3000) == [0, 0], launched.words()
        finally:
            launched.kill()
        one, other = last_checkpoint(alone), last_checkpoint(whole)
        gradients = sum(value.nbytes for value in one["state_dict"].values())
        apart = distance(one["state_dict"], other["state_dict"])
        with capsys.disabled():
            print(
                f"\n40 steps of 4 ranks and of one process: weights differ by {apart:.1e} of their norm; the "
                f"first host sent {(sent() - before) / 1e6:.1f} MB, gradients are {gradients / 1e6:.2f} MB"
            )
        assert one["global_step"] == other["global_step"] == 40 and apart < 1e-3

        for fault, step in (("a killed rank", 10), ("a cut link", 20)):
            port += 1
            launched = Launched(data, broken, port)
            try:
                wait_for_step(broken, step, launched)
                begun = time.monotonic()
                if fault == "a killed rank":
                    launched.ranks(1)[-1].kill()
                else:
                    ip("-n", HOSTS[1], "link", "set", "cable0", "down")
                codes = launched.wait(3 * MINUTE)
                took = time.monotonic() - begun
                with capsys.disabled():
                    print(f"{fault}: all ended after {took:.0f} s")
                assert all(codes) and "of this run ended, or cannot be reached." in launched.words()
                assert took < MINUTE + 30  # torchrun's own half minute for those that it ends
            finally:
                launched.kill()
                ip("-n", HOSTS[1], "link", "set", "cable0", "up")
        launched = Launched(data, broken, port + 1)
        try:
            assert launched.wait(3000) == [0, 0], launched.words()
        finally:
            launched.kill()
    apart = distance(last_checkpoint(whole)["state_dict"], last_checkpoint(broken)["state_dict"])
    with capsys.disabled():
        print(f"gone on twice: weights differ by {apart:.1e} of their norm")
    assert apart < 1e-4  # sums of more than two ranks are rounded otherwise in the first step after a start


def test_under_slurm_a_run_that_gives_way_is_queued_again_and_ends_bit_for_bit(tmp_path, monkeypatch):
    """By scripts/train.sbatch, on a Slurm of one machine; SIGUSR1 as when the time is up."""
    data = write_dataset(tmp_path / "data")
    same = "trainer=ddp", "trainer.accelerator=cpu", "trainer.precision=32-true", "trainer.devices=1"
    steps = [
        "trainer.max_steps=12",
        "callbacks.last.every_n_steps=2",
        "validation_every=100",
        "callbacks.previews=null",
    ]
    run_training(data, tmp_path / "whole", *steps)
    run, cluster = tmp_path / "run", tmp_path / "slurm"
    script = SRC.parent / "scripts" / "train.sbatch"
    words = overrides(data, run, *steps, *same)
    (tmp_path / "job").write_text(f"#!/bin/bash\nset -- {shlex.join(words)}\n{script.read_text()}")
    monkeypatch.setenv("PYTHON", sys.executable)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.chdir(SRC.parent)
    with slurm(cluster, {}) as environ:
        subprocess.run([str(cluster / "bin" / "sbatch"), str(tmp_path / "job")], env=environ, check=True)
        until, sent = time.monotonic() + 1500, False
        while (job := jobs(cluster)["100"])["state"] not in FINAL:
            if not sent and (steps_of(run / "checkpoints" / "last.ckpt") or 0) >= 2:
                send(cluster, "100", signal.SIGUSR1)
                sent = True
            assert time.monotonic() < until
            time.sleep(0.2)
        said = (cluster / "jobs" / "100.log").read_text()
    assert (job["state"], job["tries"]) == ("COMPLETED", 2), said[-4000:]
    assert (cluster / "scontrol.log").read_text() == "requeue 100\n" and "stopped by SIGUSR1. Step " in said
    assert_same_state(last_checkpoint(tmp_path / "whole"), last_checkpoint(run))


def test_a_run_goes_on_with_another_number_of_ranks_to_the_same_draws(tmp_path, capsys):
    """Six steps of one process, the rest of two: what one process of the same batch makes, but for rounding."""
    data = write_dataset(tmp_path / "data")
    steps = [
        "callbacks.last.every_n_steps=3",
        "validation_every=100",
        "callbacks.previews=null",
        "optimizer.decay=none",
    ]
    run_training(data, tmp_path / "whole", *steps, "trainer.max_steps=12")
    run_training(data, tmp_path / "other", *steps, "trainer.max_steps=6")
    words = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.precision=32-true", "trainer.devices=2"]
    command = [sys.executable, str(SRC / "train.py")]
    command += overrides(data, tmp_path / "other", *steps, "trainer.max_steps=12", *words)
    done = subprocess.run(command, capture_output=True, text=True, env=environment() | {"PYTHONPATH": str(SRC)})
    assert done.returncode == 0, done.stderr[-4000:]
    one, other = (last_checkpoint(tmp_path / name)["state_dict"] for name in ("whole", "other"))
    before = torch.load(tmp_path / "whole" / "checkpoints" / "previous.ckpt", weights_only=True)["state_dict"]
    apart, moved = distance(one, other), distance(one, before)
    with capsys.disabled():
        print(f"\nsix steps of one process, six of two: weights differ by {apart:.2e}; three steps move {moved:.2e}")
    assert apart < 0.05 * moved
