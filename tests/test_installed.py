"""The wheel, built and installed without a network, in an empty folder: what the README names works there too."""

import os
import shutil
import subprocess
import sys
from importlib.metadata import Distribution
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nerfdiff

PROJECT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "setup.py", "MANIFEST.in", "LICENSE", "README.md", "src", "conf", "assets")
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
FIRST = ("calibrate", "chart", "demo", "distill", "evaluate")
COMMANDS = (*FIRST, "export", "inspect-data", "make-scenes", "make-shards", "merge-shards", "picture", "train", "view")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder that the wheel is installed into; built from a copy, as building leaves files beside the sources."""
    sources, site = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("site")
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in SOURCES:
        if (PROJECT / name).is_dir():
            shutil.copytree(PROJECT / name, sources / name, ignore=ignored)
        else:
            shutil.copy(PROJECT / name, sources)
    offline = ["--no-deps", "--no-index"]
    subprocess.run([*PIP, "wheel", *offline, "--no-build-isolation", "-w", sources, sources], check=True)
    (wheel,) = sources.glob("nerfdiff-*.whl")
    subprocess.run([*PIP, "install", *offline, "--target", site, wheel], check=True)
    return site


@pytest.fixture
def shell(site, tmp_path):
    """Runs words in an empty folder, where only what is installed can be found."""
    environment = os.environ | {"PYTHONPATH": str(site), "PATH": f"{site / 'bin'}{os.pathsep}{os.environ['PATH']}"}

    def run(*words: str, status: int = 0, **more: str) -> str:
        done = subprocess.run(
            words, cwd=tmp_path, env=environment | {"OMP_NUM_THREADS": "1"} | more, capture_output=True, text=True
        )
        assert done.returncode == status, done.stderr
        return done.stdout + done.stderr

    return run


def test_the_wheel_holds_what_a_checkout_has(site):
    for folder in ("conf", "assets"):
        files = {path.relative_to(PROJECT) for path in (PROJECT / folder).rglob("*") if path.is_file()}
        assert files and all((site / "nerfdiff" / file).read_bytes() == (PROJECT / file).read_bytes() for file in files)
    for folder in ("procedural", "nerfdiff/chart", "nerfdiff/exports"):
        files = [path.relative_to(PROJECT / "src") for path in (PROJECT / "src" / folder).rglob("*.*")]
        assert files and all((site / file).is_file() for file in files if file.suffix != ".pyc"), folder
    (info,) = site.glob("nerfdiff-*.dist-info")
    installed = Distribution.at(info)
    assert [one for one in installed.requires if "mitsuba" in one] == ['mitsuba>=3.6; extra == "scenes"']
    assert installed.version == nerfdiff.__version__
    assert sorted(one.name for one in installed.entry_points) == [f"nerfdiff-{name}" for name in COMMANDS]


def test_every_command_composes(site, shell):
    code = """
import runpy, sys, nerfdiff
print(nerfdiff.__file__)
for name in sys.argv[1:]:
    sys.argv = [name, "--cfg", "job"]
    runpy.run_module(f"nerfdiff.commands.{name.replace('-', '_')}", run_name="__main__")
"""
    said = shell(sys.executable, "-c", code, *COMMANDS)
    assert said.startswith(str(site)) and said.count("\nconditioning:") == 1 and said.count("\nckpt: ???") == 2


def test_the_shipped_model_makes_a_scene_of_a_picture(site, shell, tmp_path):
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:30, 15:45] = (200, 30, 40, 255)
    Image.fromarray(pixels).save(tmp_path / "my car (1).png")
    small = ("budget=minutes", "strategy=none", "orbit.frames=2", "picture_views.views=2", "run_name=out")
    said = shell("nerfdiff-distill", "ckpt=demo", "image=my car (1).png", *small)
    assert list(tmp_path.glob("runs/out/none-*/predictions/none/my_car_1/field.safetensors"))
    assert "metrics.weights" not in said  # metrics that nobody asked for


def test_five_lines_of_python_make_a_scene_of_a_picture(shell, tmp_path):
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:30, 15:45] = (200, 30, 40, 255)
    Image.fromarray(pixels).save(tmp_path / "car.png")
    (tmp_path / "five.py").write_text("""import nerfdiff
model = nerfdiff.load("demo")
scene = model.distil("car.png", strategy="none")
scene.orbit("car.mp4", frames=2, height=64)
scene.save("car.glb", "mesh.resolution=32", "mesh.colour_views=0")
""")
    shell(sys.executable, "five.py")
    assert {path.name for path in tmp_path.iterdir()} == {"car.png", "five.py", "car.mp4", "car.glb"}


def test_shells_are_told_what_completes_a_word(shell):
    assert shell("nerfdiff-train", "-sc", "install=bash").rstrip().endswith("hydra_bash_completion nerfdiff-train")
    completed = shell("nerfdiff-train", "-sc", "query=bash", COMP_LINE="nerfdiff-train model=")
    assert completed.split() == ["model=base", "model=large", "model=small", "model=tiny"]
