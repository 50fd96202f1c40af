"""Numbers, files and folders that cannot be: refused in a sentence that names them, before anything is lost."""

import copy
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from PIL import Image

from fault_fixtures import *  # noqa: F403
from nerfdiff.cli import explain, load_config, prepare_arguments
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.formats.images import decode
from nerfdiff.data.formats.npz_files import read_array
from nerfdiff.data.formats.posed_files import read_text
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.distill.distillation import Distillation
from nerfdiff.evaluation.distill import distill
from nerfdiff.limits import check_limits
from nerfdiff.results.row import read_rows
from nerfdiff.utils.errors import ConfigError, DataError, OutOfMemory, UserError
from nerfdiff.utils.files import atomic, remove_leftovers
from training_fixtures import evaluation_overrides, overrides, run_training


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ("train", "trainer.max_steps=0"),
        ("train", "trainer.max_steps=-1"),
        ("train", "trainer.accumulate_grad_batches=0"),
        ("train", "model.render.uniform_samples=0"),
        ("train", "model.render.chunk=1"),
        ("train", "seed=-1"),
        ("train", "seed=4294967296"),
        ("train", "optimizer.lr=nan"),
        ("train", "optimizer.lr=inf"),
        ("train", "optimizer.lr=-1"),
        ("train", "optimizer.lr=0"),
        ("train", "optimizer.betas=[0.9,1.0]"),
        ("train", "optimizer.weight_decay=-0.1"),
        ("train", "validation_every=0"),
        ("train", "validation_times=[0.5,2]"),
        ("train", "callbacks.last.every_n_steps=0"),
        ("train", "callbacks.nonfinite.patience=0"),
        ("train", "threads=0"),
        ("train", "data.image_size=0"),
        ("train", "data.num_workers=-1"),
        ("train", "trainer.log_every_n_steps=0"),
        ("train", "model.unet.channel_mult=[1,0]"),
        ("distill", "uniform_samples=0"),
        ("distill", "importance_samples=-3"),
        ("distill", "chunk=1"),
        ("distill", "seed=-1"),
        ("distill", "budget.views=0"),
        ("distill", "budget.rays=0"),
        ("distill", "budget.steps=0"),
        ("distill", "budget.inner_steps=-1"),
        ("distill", "strategy.views_at_once=0"),
        ("distill", "strategy.lr_planes=nan"),
        ("distill", "picture.fov=nan"),
        ("distill", "minutes=0"),
        ("distill", "orbit.frames=-1"),
        ("distill", "orbit.fps=0"),
        ("evaluate", "threads=-2"),
        ("evaluate", "sheet.views=0"),
        ("evaluate", "mean_image_scenes=0"),
        ("evaluate", "metrics.geometry.depth_tails=-1"),
        ("evaluate", "threads=text"),
        ("train", "model.render.background=nan"),
        ("inspect_data", "seed=-1"),
    ],
)
def test_numbers_that_cannot_be_are_refused(command, word, defaults):
    key, _, value = word.partition("=")
    config = copy.deepcopy(defaults[command])
    OmegaConf.update(config, key, yaml.safe_load(value.replace("nan", ".nan").replace("inf", ".inf")))
    with pytest.raises(ConfigError, match=rf"^{re.escape(key)}=.* must be "):
        check_limits(config)


@pytest.mark.parametrize("group", ["orbit", "sheet"])
def test_settings_that_are_needed_are_not_taken_away(group, defaults):
    config = copy.deepcopy(defaults["distill"])
    config[group] = None
    with pytest.raises(ConfigError, match=rf"^{group}=null: for none, set {group}\."):
        check_limits(config)


@pytest.fixture(scope="module")
def defaults():
    """Of all commands; theirs can be."""
    known = {name: [] for name in ("train", "inspect_data", "export", "make_scenes", "chart", "demo")}
    known |= {"distill": ["ckpt=demo"], "evaluate": ["ckpt=demo"]}
    return {command: load_config(command, words) for command, words in known.items()}


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("compile=[]", r"compile takes text \(default none\), got \[\]"),
        ("compile={}", "compile takes text"),
        ("model.render.background=text", "model.render.background takes int or float"),
        ("trainer.max_steps='${nothing}'", "Interpolation key 'nothing' not found"),
    ],
)
def test_values_of_another_kind_are_refused(word, said):
    with pytest.raises((ConfigError, OmegaConfBaseException)) as error:
        OmegaConf.resolve(load_config("train", [word]).trainer)
    assert re.match(said, explain(error.value))


def test_several_devices_can_be_named():
    assert load_config("train", ["trainer.devices=[0,1]"]).trainer.devices == [0, 1]


@pytest.mark.parametrize("words", [["seed=-1"], ["-m", "seed=0,-1"], ["experiment=overfit", "seed=-1"]])
def test_they_are_refused_by_commands_and_sweeps(words):
    with pytest.raises(ConfigError, match=r"^seed=-1 must be from 0 to 2\^32 - 1"):
        prepare_arguments("train", [], words)


def test_what_is_set_by_another_key_is_checked_too():
    with pytest.raises(ConfigError, match="must be at least 1"):
        load_config("distill", ["ckpt=demo", "budget.views=${orbit.frames}", "orbit.frames=0"])


@pytest.fixture
def small(fault_data, fault_run, tmp_path):
    def config(*more):
        words = "strategy=ngd", "budget=minutes", "budget.steps=1", "budget.views=2", "per_scene=false", *more
        return load_config("distill", evaluation_overrides(fault_data, fault_run, tmp_path / "out", *words))

    return config


def test_rays_that_do_not_fit_memory_are_a_row_that_says_so(small, tmp_path):
    with pytest.raises(OutOfMemory, match=r"1000000000000 rays a step take .* TB .* lower budget\.rays"):
        distill(small("budget.rays=1000000000000"))
    (row,) = read_rows(tmp_path / "out" / "results.jsonl")
    assert row.status == "oom" and "budget.rays" in row.error


def test_memory_that_the_system_refuses_is_a_row_that_says_so(small, tmp_path, monkeypatch):
    def greedy(*arguments):
        torch.empty(2**50)

    monkeypatch.setattr(Distillation, "predict", greedy)
    with pytest.raises(RuntimeError) as error:
        distill(small())
    assert read_rows(tmp_path / "out" / "results.jsonl")[0].status == "oom"
    said = explain(error.value, small())
    assert said.startswith("memory ran out") and "lower data.batch_size, budget.rays" in said and "\n" not in said


def fifo(path):
    os.mkfifo(path)


def loop(path):
    path.symlink_to(path.name)


def dangling(path):
    path.symlink_to("nowhere")


def device(path):
    path.symlink_to("/dev/zero")


FILES = [fifo, loop, dangling, device]


@pytest.mark.parametrize("make", FILES)
@pytest.mark.parametrize("read", [decode, lambda path: read_text(path, "text"), lambda path: read_array(path, "a", "")])
def test_what_is_no_file_is_refused_and_not_waited_for(make, read, tmp_path):
    make(tmp_path / "x.png")
    with pytest.raises(DataError, match=r"x\.png: "):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("make", [fifo, loop])
@pytest.mark.parametrize(
    ("command", "key"),
    [("distill", "image"), ("distill", "ckpt"), ("distill", "data.root"), ("train", "data.root"), ("train", "out")],
)
def test_what_is_no_file_is_refused_by_commands(make, command, key, fault_data, tmp_path):
    """Also as the folder of a run."""
    make(tmp_path / "x")
    path = tmp_path / "x"
    words = [f"paths.run_dir={path}", f"data.root={fault_data}"] if key == "out" else [f"{key}={path}"]
    words += ["ckpt=demo"] if command == "distill" and key != "ckpt" else []
    with pytest.raises(UserError, match=f"{path}"):
        prepare_arguments(command, ["ckpt", "image", "data.root"] if command == "distill" else ["data.root"], words)


@pytest.mark.parametrize(
    ("make", "place"),
    [
        *((make, place) for make in (loop, fifo) for place in ("", "scene0/rgb", "scene0/rgb/000000.png")),
        (fifo, "scene0/pose/000000.txt"),
        (loop, "scene0/pose/000000.txt"),
        (loop, "scene0"),  # a pipe beside scenes is none, as any other file there
    ],
)
def test_links_in_a_circle_and_pipes_within_a_dataset_are_refused(make, place, fault_data, tmp_path):
    root = shutil.copytree(fault_data, tmp_path / "data")
    path = root / "cars_train" / place
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    make(path)
    with pytest.raises((UserError, OSError, RuntimeError)) as error:
        CachedReader(SRNReader(root, "cars", "train", 0.8, 1.8, None), tmp_path / "cache", "toy")
    assert path.name in (said := explain(error.value)) and "Traceback" not in said


def test_pictures_that_are_too_large_are_refused(tmp_path):
    """By their header, before 169 million pixels are decoded."""
    Image.new("1", (13_000, 13_000)).save(tmp_path / "large.png")
    with pytest.raises(DataError, match=r"large\.png: 13000x13000 are 169 million pixels, expected at most 64 million"):
        decode(tmp_path / "large.png")
    Image.fromarray(np.zeros((4, 16_000), np.uint8)).save(tmp_path / "wide.png")
    assert decode(tmp_path / "wide.png").shape == (4, 16_000, 3)


@pytest.fixture
def read_only(tmp_path):
    """A folder on a file system that is mounted so; root may write anywhere else."""
    folder = tmp_path / "mounted"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "ro,size=1m", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        folder.chmod(0o500)
        if os.access(folder, os.W_OK):
            pytest.skip("nothing can be mounted here, and root may write anywhere")
        yield folder
        folder.chmod(0o700)
        return
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("name", ["", "new/run"])
def test_folders_that_cannot_be_written_are_refused(name, read_only, fault_data):
    run = read_only / name
    for command, more in (("train", []), ("distill", ["ckpt=demo"])):
        with pytest.raises(DataError, match=f"{run}: {read_only} cannot be written; choose another paths"):
            prepare_arguments(command, [], [*more, f"data.root={fault_data}", f"paths.run_dir={run}"])
    with pytest.raises(UserError, match=str(read_only)):
        run_training(fault_data, run)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "Permission denied", "/x/y"), "/x/y: Permission denied"),
        (OSError(40, "Too many levels of symbolic links", "/x"), "/x: Too many levels of symbolic links"),
        (RuntimeError("Symlink loop from '/x'"), "Symlink loop from '/x'"),
        (MemoryError(), "memory ran out"),
        (OSError("Caught OSError in worker 0.\nTraceback:\nOSError: [Errno 5] I/O"), "OSError: [Errno 5] I/O"),
        (ValueError("a fault of the program's"), None),
    ],
)  # fmt: skip
def test_what_the_system_refuses_is_a_sentence(error, said):
    assert explain(error) == said
    assert explain(MemoryError(), OmegaConf.create({"chunk": 3})) == "memory ran out: lower chunk"


def test_half_written_files_of_killed_processes_go_at_the_next_start(fault_data, damaged_run):
    left = [
        damaged_run / "checkpoints" / ".last.123.tmp.ckpt",
        damaged_run / "checkpoints" / ".previous.77.tmp.ckpt",
        damaged_run / "model" / ".model.9.tmp.safetensors",
        damaged_run / ".config.123.tmp.yaml",
    ]
    others = [damaged_run / "checkpoints" / name for name in (".mine.tmp.ckpt", "x.1.tmp.ckpt", ".notes.tmp")]
    for path in left + others:
        path.write_bytes(b"half")
    run_training(fault_data, damaged_run, "data.image_size=[20,28]", "trainer.max_steps=2", "optimizer.decay=none")
    assert not any(path.exists() for path in left) and all(path.exists() for path in others)


def test_what_this_process_is_writing_stays(tmp_path):
    with atomic(tmp_path / "a.txt") as temporary:
        temporary.write_text("x")
        remove_leftovers(tmp_path)
    assert (tmp_path / "a.txt").read_text() == "x"


def test_half_scene_folders_go_when_the_scene_is_made(small, tmp_path):
    distill(small("budget.rays=8", "sheet.scenes=0"))
    (folder,) = (tmp_path / "out").glob("ngd-*/predictions/ngd")
    (folder / "scene1" / "scene.json").unlink()
    half, other = folder / ".scene1.4.tmp", folder / ".scene10.4.tmp"  # the latter may be another process's
    for path in (half, other):
        (path / "rgb").mkdir(parents=True)
    distill(small("budget.rays=8", "sheet.scenes=0"))
    assert (folder / "scene1" / "scene.json").exists() and not half.exists() and other.exists()


def test_commands_end_with_one_line(tmp_path, fault_data):
    """The reported ones, as a person starts them."""
    words = overrides(fault_data, tmp_path / "run", "optimizer.lr=nan")
    done = subprocess.run([sys.executable, "src/train.py", *words], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "error: optimizer.lr=nan must be a finite number\n")
