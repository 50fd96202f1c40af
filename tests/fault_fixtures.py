"""A small run that tests damage, each its own copy, and how to damage it."""

import random
import shutil
import zipfile
from pathlib import Path

import pytest
import torch

from training_fixtures import run_training, write_dataset


@pytest.fixture(scope="session")
def fault_data(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("fault_data"))


@pytest.fixture(scope="session")
def fault_run(fault_data, tmp_path_factory) -> Path:
    """Of two steps, with last.ckpt, previous.ckpt, best.ckpt and model/; not to be changed."""
    run = tmp_path_factory.mktemp("fault_run") / "run"
    more = "callbacks.last.every_n_steps=1", "optimizer.decay=none", "validation_every=1", "data.image_size=[20,28]"
    run_training(fault_data, run, "trainer.max_steps=2", *more)
    return run


@pytest.fixture
def damaged_run(fault_run, tmp_path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(fault_run, tmp_path / "run")


def go_on(data: Path, run: Path, *more: str) -> dict[str, float]:
    """The command that goes on with `fault_run`."""
    steps = "trainer.max_steps=3", "callbacks.last.every_n_steps=1", "optimizer.decay=none", "validation_every=1"
    return run_training(data, run, "data.image_size=[20,28]", *steps, *more)


def flip(path: Path, count: int, seed: int, start: int = 0, end: int | None = None) -> None:
    """Invert some bits of `count` bytes of a file, between two positions."""
    draw, content = random.Random(seed), bytearray(path.read_bytes())
    for _ in range(count):
        content[draw.randrange(start, end or len(content))] ^= draw.randrange(1, 256)
    path.write_bytes(content)


def flip_weights(path: Path, count: int, seed: int) -> None:
    """The same within the bytes of a checkpoint's largest tensor."""
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
        with archive.open(largest) as file:
            start = file._orig_compress_start  # CPython's name for where an entry's bytes begin
    flip(path, count, seed, start, start + largest.file_size)


def change(path: Path, **entries) -> None:
    """Save a checkpoint with other entries."""
    torch.save(torch.load(path, weights_only=True) | entries, path)
