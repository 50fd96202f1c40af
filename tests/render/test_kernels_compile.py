"""Kernels become machine code of a GPU that need not be there: what the interpreter runs must compile as well."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton.backends.nvidia")


def test_every_kernel_compiles_for_hopper():
    # a process of its own, since this one's kernels may be the interpreter's, and without the types' import hook
    root = Path(__file__).parents[2]
    script = root / "tests" / "render" / "compile_kernels.py"
    environment = os.environ | {"PYTHONPATH": str(root / "src")}
    done = subprocess.run([sys.executable, script, "90"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    names = [line.split()[0] for line in done.stdout.splitlines()]
    kernels = ["cells_kernel", "coarse_kernel", "composite_kernel", "gradient_kernel", "merge_kernel"]
    assert sorted(set(names)) == kernels
    assert all(int(line.split()[1]) > 1000 for line in done.stdout.splitlines())
