"""Faults at random moments of training, distillation and files: `make faults`; what is drawn has fixed seeds.

Each test prints a line for the table of docs/reliability.md: tries, survived, lost.
"""

import fcntl
import json
import os
import pickle
import random
import shutil
import signal
import struct
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import torch

from fault_child import start
from fault_fixtures import *  # noqa: F403
from fault_fixtures import flip
from nerfdiff.checkpoint import load_model, read_checkpoint
from nerfdiff.cli import load_config
from nerfdiff.evaluation.distill import distill
from nerfdiff.metrics.predictions import read_prediction
from nerfdiff.results.row import read_rows
from nerfdiff.utils.errors import UserError
from training_fixtures import (
    assert_same_state,
    command,
    environment,
    evaluation_overrides,
    last_checkpoint,
    run_training,
)

pytestmark = pytest.mark.faults
TESTS = Path(__file__).parents[1]

STEPS = ["trainer.max_steps=16", "callbacks.last.every_n_steps=1", "validation_every=8"]


@pytest.fixture
def tally(request, capsys):
    """Counts what was tried and what was lost; a test with a loss fails."""

    class Tally:
        tries = lost = 0

        def add(self, fine: bool, why: str = "") -> None:
            self.tries += 1
            self.lost += not fine
            if not fine:
                print(why)

    count = Tally()
    yield count
    with capsys.disabled():
        name = request.node.name.removeprefix("test_").replace("_", " ")
        print(f"\n| {name} | {count.tries} | {count.tries - count.lost} | {count.lost} |")
    assert count.tries and not count.lost


@pytest.fixture(scope="module")
def whole(fault_data, tmp_path_factory):
    """The run that nothing happened to, and the seconds that it took."""
    run, began = tmp_path_factory.mktemp("whole") / "run", time.monotonic()
    run_training(fault_data, run, *STEPS)
    return run, time.monotonic() - began


def endure(tally, folder: Path, data: Path, whole, signums, tries: int, seed: int, run: Path | None = None) -> None:
    """Signals at random moments, each followed by the same command, until so many hit; the end is the same, bit for
    bit."""
    draw, run, hits, last = random.Random(seed), run or folder / "run", 0, 0
    while True:
        child = start(folder, lambda: run_training(data, run, *STEPS))
        if hits < tries:
            time.sleep(draw.uniform(0.02, 0.8) * whole[1])
            child.kill(signum := draw.choice(signums))
        status = child.wait()
        path = run / "checkpoints" / "last.ckpt"
        step = read_checkpoint(path)["global_step"] if path.exists() else 0
        if status == 0:
            hits += 1
            if hits <= tries:  # it came too late
                shutil.rmtree(run)
                last = 0
                continue
            break
        hits += 1
        expected = -signum if signum == signal.SIGKILL else 128 + signum
        tally.add(status == expected and step >= last, f"{status} at step {step} after {last}: {child.words()}")
        last = step
    same_as_whole(tally, run, whole)
    assert not list(run.rglob("*.tmp.*"))


def same_as_whole(tally, run: Path, whole) -> None:
    try:
        assert_same_state(last_checkpoint(whole[0]), last_checkpoint(run))
        tally.add(True)
    except AssertionError as error:
        tally.add(False, f"another end: {error}")


def test_kills_of_a_training(fault_data, whole, tmp_path, tally):
    endure(tally, tmp_path, fault_data, whole, [signal.SIGKILL], tries=12, seed=1)


def test_signals_to_a_training(fault_data, whole, tmp_path, tally):
    endure(tally, tmp_path, fault_data, whole, [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], tries=9, seed=2)


def test_two_trainings_in_one_folder(fault_data, whole, tmp_path, tally):
    """The second is refused, wherever the first is, or comes after it."""
    draw = random.Random(3)
    for number in range(4):
        run = tmp_path / str(number)
        first = start(tmp_path, lambda run=run: run_training(fault_data, run, *STEPS))
        time.sleep(draw.uniform(0, 0.5) * whole[1])
        second = start(tmp_path, lambda run=run: run_training(fault_data, run, *STEPS, "seed=9"))
        ends = sorted([first.wait(), second.wait()])
        said = first.words() + second.words()
        fine = ends == [0, 1] and ("is working in" in said or "other training" in said)
        tally.add(fine, f"{ends}: {said}")
        if not second.words():  # it came first
            continue
        same_as_whole(tally, run, whole)


@pytest.fixture(scope="module")
def distilled(fault_data, fault_run, tmp_path_factory):
    out, began = tmp_path_factory.mktemp("distilled"), time.monotonic()
    distill(distillation(fault_data, fault_run, out))
    return out, time.monotonic() - began


def distillation(data: Path, run: Path, out: Path, *more: str):
    small = "budget.steps=2", "budget.inner_steps=2", "budget.rays=32", "budget.views=2", "orbit.frames=2"
    words = "strategy=ngd", "budget=minutes", *small, "metrics.st_lpips=false", "sheet.scenes=0", *more
    return load_config("distill", evaluation_overrides(data, run, out, *words))


def predictions(out: Path) -> Path:
    (folder,) = out.glob("ngd-*/predictions/ngd")
    return folder


@pytest.mark.parametrize("processes", [1, 2])
def test_kills_of_a_distillation(processes, fault_data, fault_run, distilled, tmp_path, tally):
    """Alone, and beside another one that shares the scenes."""
    draw, out = random.Random(4), tmp_path / "out"
    for _ in range(6):
        children = [
            start(tmp_path, lambda: distill(distillation(fault_data, fault_run, out))) for _ in range(processes)
        ]
        time.sleep(draw.uniform(0.1, 0.9) * distilled[1])
        children[0].kill()
        ends = [child.wait() for child in children]
        tally.add(
            ends[0] in (-signal.SIGKILL, 0) and set(ends[1:]) <= {0}, f"{ends}: {[child.words() for child in children]}"
        )
        for scene in out.glob("ngd-*/predictions/ngd/scene*"):
            read_prediction(scene.parent, scene.name)
    distill(distillation(fault_data, fault_run, out))
    for scene in ("scene0", "scene1", "scene2"):
        here, there = (read_prediction(predictions(place), scene).pixels for place in (out, distilled[0]))
        tally.add(torch.equal(here, there), f"{scene} differs")
    assert not list(predictions(out).glob(".scene*"))
    assert all(row.n_scenes == 3 for row in read_rows(out / "results.jsonl"))


@contextmanager
def mounted(folder: Path, *options: str):
    folder.mkdir()
    if os.geteuid() != 0:
        pytest.skip("only root may mount")
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"nothing can be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=False)


def test_a_disk_that_fills_up(fault_data, whole, tmp_path, tally):
    """At random steps, by another's file; with room again the same command goes on to the same end."""
    draw, size = random.Random(5), 16 * (whole[0] / "checkpoints" / "last.ckpt").stat().st_size
    for number in range(4):
        with mounted(tmp_path / f"disk{number}", "-t", "tmpfs", "-o", f"size={size}", "none") as disk:
            run, filler = disk / "run", disk / "filler"
            child = start(tmp_path, lambda run=run: run_training(fault_data, run, *STEPS))
            time.sleep(draw.uniform(0.2, 0.7) * whole[1])
            with open(filler, "wb", buffering=0) as file:
                try:
                    while file.write(b"x" * 65536):
                        pass
                except OSError:
                    pass
            status = child.wait()
            tally.add(status in (0, 1), f"{status}: {child.words()}")
            filler.unlink()
            again = start(tmp_path, lambda run=run: run_training(fault_data, run, *STEPS))
            tally.add(again.wait() == 0, again.words())
            same_as_whole(tally, run, whole)


SHUTDOWN, NO_LOG_FLUSH = 0x8004587D, struct.pack("I", 2)
"""The ioctl with which ext4 and XFS stop at once, as a disk whose power is cut, and its flag."""


def test_power_cuts_on_ext4(fault_data, whole, tmp_path, tally):
    """What is not on the disk by then is gone, and files that are renamed before they are written are empty."""
    if not (shutil.which("mkfs.ext4") and Path("/dev/loop-control").exists()):
        pytest.skip("there is no mkfs.ext4, or no loop device")
    draw, image = random.Random(6), tmp_path / "disk.img"
    with open(image, "wb") as file:
        file.truncate(512 * 2**20)
    subprocess.run(["mkfs.ext4", "-q", "-F", str(image)], check=True)
    mount = ["-o", "loop,noauto_da_alloc", str(image)]
    last = 0
    for number in range(6):
        with mounted(tmp_path / f"disk{number}", *mount) as disk:
            child = start(tmp_path, lambda disk=disk: run_training(fault_data, disk / "run", *STEPS))
            time.sleep(draw.uniform(0.1, 0.9) * whole[1])
            root = os.open(disk, os.O_RDONLY)
            fcntl.ioctl(root, SHUTDOWN, NO_LOG_FLUSH)
            os.close(root)
            child.kill()
            child.wait()
        with mounted(tmp_path / f"again{number}", *mount) as disk:
            path = disk / "run" / "checkpoints" / "last.ckpt"
            try:
                step = read_checkpoint(path)["global_step"] if path.exists() else 0
                tally.add(step >= last, f"step {step} after {last}")
                last = step
            except UserError as error:
                tally.add(False, str(error))
    with mounted(tmp_path / "end", *mount) as disk:
        run_training(fault_data, disk / "run", *STEPS)
        same_as_whole(tally, disk / "run", whole)


def same_tensors(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(torch.equal(value, other[name]) for name, value in one.items())


def test_flipped_bytes_of_a_checkpoint(fault_run, tmp_path, tally):
    """One byte anywhere: refused, or of those that mean nothing."""
    sound = fault_run / "checkpoints" / "last.ckpt"
    before = last_checkpoint(fault_run)["state_dict"]
    for seed in range(200):
        path = Path(shutil.copy(sound, tmp_path / f"{seed}.ckpt"))
        flip(path, 1, seed)
        with refusal(tally):
            assert same_tensors(before, read_checkpoint(path)["state_dict"])
        path.unlink()


def test_flipped_bytes_of_exported_weights(fault_run, tmp_path, tally):
    before = load_model(fault_run / "model", "ema")
    for seed in range(60):
        folder = shutil.copytree(fault_run / "model", tmp_path / str(seed))
        flip(folder / ("model.yaml" if seed % 3 == 0 else "model.safetensors"), 1, seed)
        with refusal(tally):
            loaded = load_model(folder, "ema")
            assert same_tensors(before.model.state_dict(), loaded.model.state_dict()) and before.config == loaded.config


@contextmanager
def refusal(tally):
    """What is inside either works or is refused in one line."""
    try:
        yield
        tally.add(True)
    except UserError as error:
        tally.add("\n" not in str(error), str(error))
    except Exception as error:
        tally.add(False, repr(error))


def test_checkpoints_with_other_contents(fault_run, tmp_path, tally):
    """Bytes of the pickle in it are others, and their CRC is right: as someone might do on purpose."""
    sound = fault_run / "checkpoints" / "last.ckpt"
    for seed in range(150):
        draw, path = random.Random(seed), tmp_path / f"{seed}.ckpt"
        with zipfile.ZipFile(sound) as old, zipfile.ZipFile(path, "w") as new:
            for name in old.namelist():
                content = bytearray(old.read(name))
                if name.endswith("data.pkl"):
                    for _ in range(draw.randint(1, 4)):
                        content[draw.randrange(len(content))] = draw.randrange(256)
                new.writestr(name, bytes(content))
        with refusal(tally):
            load_model(path, "ema")
        path.unlink()


def test_pickles_that_run_something(tmp_path, tally):
    for number, (module, name) in enumerate(
        [("os", "system"), ("builtins", "exec"), ("subprocess", "Popen"), ("torch", "load"), ("posix", "remove"),
         ("builtins", "getattr"), ("torch.hub", "load"), ("importlib", "import_module"), ("shutil", "rmtree"),
         ("numpy", "load")]
    ):  # fmt: skip
        done = tmp_path / "done"
        code = f"c{module}\n{name}\n(S'touch {done}'\ntR.".encode()
        for packed in (False, True):
            path = tmp_path / f"{number}{packed}.ckpt"
            if packed:
                with zipfile.ZipFile(path, "w") as archive:
                    archive.writestr("archive/data.pkl", code)
                    archive.writestr("archive/version", "3\n")
                    archive.writestr("archive/byteorder", "little")
            else:
                path.write_bytes(pickle.dumps({}) + code)
            try:
                load_model(path, "ema")
                tally.add(False, "it was loaded")
            except UserError as error:
                tally.add(not done.exists() and "weights_only" not in str(error), str(error))


@pytest.mark.parametrize("name", ["train", "distill", "evaluate"])
def test_overrides_that_are_drawn(name, fault_data, fault_run, tmp_path, tally):
    """Keys and values at random, in a process without the tests' type checks: the command works, or says one line."""
    words = [name, str(fault_data), str(fault_run), str(tmp_path)]
    script, env = TESTS / "fault_overrides.py", environment() | {"PYTHONPATH": str(TESTS.parent / "src")}
    done = subprocess.run([sys.executable, str(script), *words], capture_output=True, text=True, env=env)
    for line in done.stdout.splitlines():
        word, status, said = json.loads(line)
        tally.add(status == 0 or (status == 1 and "\n" not in said), f"{word}: {status} {said}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_of_two(victim, fault_data, tmp_path, tally):
    """The other ends too, with a sentence, and the same command goes on from what was saved."""
    run = tmp_path / "run"
    ranks = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_steps=400"]
    words = [*ranks, "callbacks.last.every_n_steps=2", "validation_every=1000"]
    process = subprocess.Popen(
        command(fault_data, run, *words), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    last, until = run / "checkpoints" / "last.ckpt", time.monotonic() + 300
    while not last.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.1)
    ranks = [psutil.Process(process.pid), *psutil.Process(process.pid).children()]
    ranks[victim].kill()
    _, said = process.communicate(timeout=300)
    ended = psutil.wait_procs(ranks[1:], timeout=60)[1] == []
    tally.add(ended and "Traceback" not in said, said)
    tally.add(read_checkpoint(last)["global_step"] >= 2, "nothing was saved")
