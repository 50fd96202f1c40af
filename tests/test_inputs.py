import subprocess
import sys
from pathlib import Path

import pytest
from hydra._internal.utils import get_args_parser

from nerfdiff.cli import prepare_arguments
from nerfdiff.commands import distill, evaluate, export, inspect_data, train
from nerfdiff.inputs import ASSETS, WEIGHTS, find_weights
from nerfdiff.utils.errors import CheckpointError, UserError

INPUTS = {"distill": ["ckpt", "image", "picture.mask", "data.root"], "evaluate": ["ckpt", "data.root"],
          "export": ["ckpt", "fields"], "train": ["data.root"], "inspect_data": ["data.root"],
          "chart": ["results"]}  # fmt: skip


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("car.png").touch()
    Path("scenes").mkdir()


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("distill", [], "ckpt must be given: add ckpt=<value>"),
        ("distill", ["sweep=strategies"], "ckpt must be given"),
        ("evaluate", ["-m", "seed=0,1"], "ckpt must be given"),
        ("export", ["field=gone.safetensors"], "gone.safetensors: no such file; name a field.safetensors"),
        ("distill", ["ckpt=dmo", "image=car.png"], "ckpt=dmo is neither a file nor a folder of a run"),
        ("export", ["ckpt=scenes", "out=x"], "Shipped models: demo"),
        ("distill", ["sweep=views", "ckpt=dmo"], "ckpt=dmo is neither"),
        ("distill", ["ckpt=demo", "image=cat.png"], "image=cat.png: no such file"),
        ("distill", ["ckpt=demo", "image=scenes"], "image=scenes: is a folder"),
        ("distill", ["ckpt=demo", "image=car.png", "picture.mask=m.png"], "picture.mask=m.png: no such file"),
        ("distill", ["ckpt=demo", "data.root=seens"], "data.root=seens: no such folder"),
        ("evaluate", ["ckpt=demo", "data.root=car.png"], "data.root=car.png: no such folder"),
        ("train", [], "data.root=data/srn_cars: no such folder"),
        ("train", ["-m", "data.root=seens", "seed=0,1"], "data.root=seens: no such folder"),
        ("inspect_data", ["data=abo"], "data.root=data/abo: no such folder"),
        ("chart", [], "results must be given"),
        ("chart", ["results=[scenes,runs]"], "results=runs: no such file or folder"),
    ],
)
def test_what_is_missing_is_said_at_once(command, words, message):
    with pytest.raises(UserError) as error:
        prepare_arguments(command, INPUTS[command], words)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("distill", ["ckpt=demo", "image=car.png"]),
        ("distill", ["ckpt=demo", "data.root=scenes"]),
        ("distill", ["sweep=conditioning", "data.root=scenes"]),  # each of whose jobs has a checkpoint of its own
        ("distill", ["sweep=strategies", "ckpt=demo,later", "data.root=scenes"]),
        ("train", ["-m", "data=srn_cars,abo"]),  # likewise data
        ("evaluate", ["-m", "ckpt=demo", "data.root=scenes", "strategy=cdm", "strategy.steps=8,16"]),
        ("train", ["--cfg", "job"]),
        ("distill", ["-h"]),
        ("distill", ["-sc", "install=bash"]),
        ("train", ["-cp", "runs/x/.hydra", "-cn", "config.yaml"]),
        ("chart", ["results=scenes"]),
    ],
)
def test_what_is_there_or_the_jobs_own_passes(command, words):
    prepare_arguments(command, INPUTS[command], words)


@pytest.mark.parametrize("words", ["-m A B", "A B -m", "A -m", "--multirun A", "A B --config-dir=scenes -m"])
def test_the_words_of_a_sweep_are_hydras_wherever_m_stands(words):
    words = words.replace("A", "data.root=scenes").replace("B", "seed=0,1").split()
    prepared = prepare_arguments("train", INPUTS["train"], words)
    found = get_args_parser().parse_args(prepared)
    assert found.multirun and len(found.overrides) == sum("=" in word and word[0] != "-" for word in words) + 1


@pytest.mark.parametrize(
    ("command", "word", "said"),
    [("distill", "ckpt=nowhere", "error: ckpt=nowhere is neither"), ("picture", "text.png", "error: text.png: ")],
)
def test_a_command_says_so_before_it_imports_anything_slow(command, word, said, tmp_path):
    (tmp_path / "text.png").touch()
    before = sorted(tmp_path.iterdir())
    code = f"""
import sys
from nerfdiff.commands.{command} import main
sys.argv = ["{command}.py", "{word}"]
try:
    main()
finally:
    assert not {{"torch", "lightning", "pandas"}} & set(sys.modules)
"""
    environment = {"PYTHONPATH": str(ASSETS.parent / "src")}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.startswith(said) and done.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before  # no run, and no row of a failure


def test_each_command_looks_for_what_it_reads(monkeypatch):
    for module in (distill, evaluate, export, train, inspect_data):
        name = module.__name__.rpartition(".")[2]
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *(["out=x"] if name == "export" else [])])
        with pytest.raises(SystemExit, match=INPUTS[name][0].replace(".", r"\.")):
            module.main()


def test_shipped_models_are_found_from_anywhere():
    assert find_weights("demo", None) == ASSETS / "demo" / WEIGHTS
    with pytest.raises(CheckpointError, match="Shipped models: none"):
        find_weights("demo", "scenes")
