"""Kills between any two touches of the disk while a checkpoint or a scene is written, found one by one."""

import os
import signal
from pathlib import Path

import pytest
import torch

from fault_child import start
from fault_fixtures import *  # noqa: F403
from nerfdiff.checkpoint import read_checkpoint
from nerfdiff.metrics.predictions import PredictionWriter, read_prediction
from nerfdiff.training.callbacks.checkpoint import ClearCheckpointIO
from nerfdiff.utils import files
from nerfdiff.utils.errors import CheckpointError

TOUCHES = ("replace", "fsync", "link", "rename", "mkdir", "chmod", "unlink", "open", "rmdir")


def killed_at(touch: int) -> None:
    """From here on, this process dies before its n-th touch of the disk."""
    left = [touch]

    def counted(act):
        def before(*arguments, **named):
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return act(*arguments, **named)

        return before

    for name in TOUCHES:
        setattr(os, name, counted(getattr(os, name)))
    torch.save = counted(torch.save)


def until_it_lives(folder: Path, function, look) -> int:
    """Kill at the first touch, the second, and so on, looking at what is left; how many kills there were."""
    for touch in range(200):

        def doomed(touch=touch):
            killed_at(touch)
            function()

        status = start(folder, doomed).wait()
        look()
        if status == 0:
            return touch
        assert status == -signal.SIGKILL
    pytest.fail("it never lived")


def step_of(path: Path) -> int | None:
    return torch.load(path, weights_only=True)["step"] if path.exists() else None


def test_a_kill_while_a_checkpoint_is_written_costs_neither_of_the_last_two(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    writer, last, previous = ClearCheckpointIO(), run / "last.ckpt", run / "previous.ckpt"
    for step in (1, 2):
        writer.save_checkpoint({"step": step}, last)
    seen = set()

    def look():
        seen.add((step_of(last), step_of(previous)))

    kills = until_it_lives(tmp_path, lambda: writer.save_checkpoint({"step": 3}, last), look)
    assert kills >= 6 and seen == {(2, 1), (2, 2), (3, 2), (3, 3)}
    files.remove_leftovers(run)
    assert sorted(path.name for path in run.iterdir()) == ["last.ckpt", "previous.ckpt"]


def test_a_kill_while_a_scene_is_written_leaves_it_whole_or_absent(tmp_path):
    images, depth = torch.rand(2, 3, 4, 4), torch.rand(2, 4, 4)

    def writer():
        return PredictionWriter(tmp_path / "out", "ngd", ["a", "b"], {"seed": 0})

    def write():
        mine = writer()
        if mine.claim("a"):
            mine.write("a", ["0", "1"], images, depth=depth, opacity=depth)

    def look():
        if "a" not in writer().pending():
            assert read_prediction(tmp_path / "out" / "ngd", "a").pixels.shape == (2, 3, 4, 4)

    assert until_it_lives(tmp_path, write, look) > 10
    again = writer()
    assert again.claim("b") and again.pending() == ("b",)
    assert not list((tmp_path / "out" / "ngd").glob(".a.*"))


def test_a_checkpoint_that_is_cut_short_anywhere_is_refused(fault_run, tmp_path):
    """As by a copy that was stopped: 40 lengths."""
    content = (fault_run / "checkpoints" / "last.ckpt").read_bytes()
    for part in range(40):
        (tmp_path / "cut.ckpt").write_bytes(content[: len(content) * part // 40])
        with pytest.raises(CheckpointError, match="not a readable checkpoint"):
            read_checkpoint(tmp_path / "cut.ckpt")
