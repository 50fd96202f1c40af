"""Processes that meet beside their work, of which one dies, hangs, or ends with the others."""

import os
import signal
import sys
import time
from datetime import timedelta

import pytest
import torch
from torch import distributed

from fault_child import start
from nerfdiff.processes import lost_process
from nerfdiff.training.callbacks.heartbeat import Heartbeat

PATIENCE = 1.5


def member(folder, rank, work):
    """A process of two; its words go to a file, as fault_child silences it."""

    def run():
        sys.stderr = open(folder / f"stderr{rank}", "w")  # noqa: SIM115
        store = distributed.FileStore(str(folder / "store"), 2)
        distributed.init_process_group("gloo", store=store, rank=rank, world_size=2, timeout=timedelta(minutes=30))
        heart = Heartbeat(str(folder), every=0.05, patience=PATIENCE)
        heart.start()
        (folder / f"ready{rank}").touch()
        work()
        heart.stop()
        heart._thread.join(10)
        assert not heart._thread.is_alive()

    return start(folder, run)


def wait_for(*paths):
    until = time.monotonic() + 120
    while not all(path.exists() for path in paths):
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_is_gone_ends_the_others_with_a_sentence(fault, tmp_path, monkeypatch):
    """Killed; or as behind a link that is cut, while the other waits in a collective for half an hour."""
    monkeypatch.setattr("nerfdiff.training.callbacks.heartbeat.GRACE", 0.2)

    def wait():
        if fault == signal.SIGSTOP:
            distributed.all_reduce(torch.ones(1))
        time.sleep(600)

    left, lost = member(tmp_path, 0, wait), member(tmp_path, 1, lambda: time.sleep(600))
    wait_for(tmp_path / "ready0", tmp_path / "ready1")
    lost.kill(fault)
    assert left.wait(60) == 1
    said = (tmp_path / "stderr0").read_text()
    assert "error: Another process of this run ended, or cannot be reached." in said and "goes on" in said
    lost.kill()
    lost.wait()


def test_who_says_that_a_process_is_gone(monkeypatch):
    """The first of those that it launched; all that torchrun did, as the first may be the one that is gone."""
    lost, parent = RuntimeError("gloo: connection closed"), os.getppid()
    monkeypatch.setattr("nerfdiff.processes._PARENT", parent)
    monkeypatch.setenv("LOCAL_RANK", "1")
    with pytest.raises(SystemExit):
        lost_process(lost)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    assert lost_process(lost) == "Another process of this run ended, or cannot be reached."
    assert lost_process(RuntimeError("something else")) is None
    taken = distributed.DistNetworkError("failed to listen, name: EADDRINUSE")
    assert "set MASTER_PORT" in lost_process(taken)


def test_processes_that_end_at_different_times_end_well(tmp_path):
    """One is slow, but not gone."""
    both = [member(tmp_path, rank, lambda rank=rank: time.sleep(0.4 * rank)) for rank in (0, 1)]
    assert [child.wait(60) for child in both] == [0, 0], [child.words() for child in both]
