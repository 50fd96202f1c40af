"""What is run where a GPU is lent for minutes, at sizes of seconds: nothing trivial is to fail on the day."""

import io
import os
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pack_scenes
from nerfdiff.checkpoint import load_model
from training_fixtures import write_dataset

ROOT = Path(__file__).parents[2]


def gpu(part: int, out: Path, **more: str) -> str:
    """What benchmarks/gpu.sh says."""
    env = os.environ | {"PYTHON": sys.executable, "TINY": "1", "OUT": str(out), "OMP_NUM_THREADS": "1"} | more
    command = ["bash", str(ROOT / "benchmarks/gpu.sh"), str(part), "300"]
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    sizes = [path.stat().st_size for path in out.iterdir()]
    assert len(sizes) <= 8 and max(sizes) < 2**24
    return done.stdout


def test_the_first_part_measures_whatever_fails(tmp_path):
    out, tests = tmp_path / "out", tmp_path / "test_passes.py"
    tests.write_text("def test_passes():\n    pass\n")
    said = gpu(1, out, TESTS=str(tests), BENCHMARKS="nothing_here ngd_object")
    assert "1 passed" in said and "nothing_here FAILED: exit status 2" in said and said.count("FAILED") == 1
    table = (out / "table.txt").read_text()
    assert table in said and "object, fast: " in table and "EXTRAPOLATED" in table
    assert "extrapolated from steps 2" in table
    with tarfile.open(out / "results.tar") as archive:
        assert sum(name.endswith(".json") for name in archive.getnames()) == 1


def test_what_the_first_part_runs_is_there():
    script = (ROOT / "benchmarks/gpu.sh").read_text()
    tests = re.search(r'local tests="([^"]*)"', script).group(1).split()
    benchmarks = re.search(r'BENCHMARKS:-"([^"]*)"', script).group(1).split()
    budgets = re.search(r'budgets="([^"]*)"', script).group(1).split()
    files = [
        *tests,
        *(f"benchmarks/{name}.py" for name in benchmarks),
        *(f"conf/budget/{name}.yaml" for name in budgets),
    ]
    assert len(tests) > 4 and len(benchmarks) > 4 and len(budgets) == 2
    assert all((ROOT / name).exists() for name in files)


def test_the_second_part_trains_two_models_and_brings_each_home(tmp_path):
    data, packs, out = write_dataset(tmp_path / "data", scenes=2, views=5), tmp_path / "packs", tmp_path / "out"
    out.mkdir()
    pack_scenes.main(["pack", str(data), str(packs / "cars.zip"), "--splits", "train"])
    said = gpu(2, out, PACKS=str(packs))
    assert "FAILED" not in said
    for name, conditioning in (("demo", "preconditioned"), ("demo_paper", "rendered")):
        with tarfile.open(out / f"{name}.tar") as archive:
            archive.extractall(tmp_path / "home", filter="data")
        loaded = load_model(tmp_path / "home" / name, "ema")
        assert loaded.model.conditioning == conditioning and loaded.trained_on[-1]["images"] == 2 * 2 * 2
        joined = b"".join(path.read_bytes() for path in sorted(out.glob(f"{name}_averages.tar.*")))
        with tarfile.open(fileobj=io.BytesIO(joined)) as archive:
            assert sum(member.endswith(".safetensors") for member in archive.getnames()) == 2


@pytest.mark.parametrize("bits", [0, 2])
def test_scenes_survive_packing(bits, tmp_path):
    data = write_dataset(tmp_path / "data", scenes=2, views=5)
    pack_scenes.main(["pack", str(data), str(tmp_path / "some.zip"), "--bits", str(bits), "--splits", "train", "val"])
    pack_scenes.main(["unpack", str(tmp_path / "some.zip"), str(tmp_path / "again")])
    scenes = sorted(path.parent.relative_to(tmp_path / "again") for path in (tmp_path / "again").rglob("rgb"))
    assert [str(scene) for scene in scenes] == [f"cars_{split}/scene{n}" for split in ("train", "val") for n in (0, 1)]
    for path in (tmp_path / "again").rglob("*.*"):
        before = data / path.relative_to(tmp_path / "again")
        if path.suffix == ".txt":
            assert path.read_text() == before.read_text()
            continue
        new, old = (np.asarray(Image.open(one).convert("RGB")).astype(int) for one in (path, before))
        assert new.shape == old.shape and np.abs(new - old).max() <= (1 << bits) - 1
        assert np.array_equal(new == 255, old == 255) and (bits == 0 or len(np.unique(new[new < 255] % 4)) <= 1)
