"""Kernels become machine code of a GPU that need not be there: what the interpreter runs must compile as well."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("triton.backends.nvidia")


def test_every_norm_kernel_compiles_for_hopper():
    # a process of its own, since this one's kernels may be the interpreter's, and without the types' import hook
    root = Path(__file__).parents[2]
    script = root / "tests" / "diffusion" / "compile_norm_kernels.py"
    environment = os.environ | {"PYTHONPATH": str(root / "src")}
    done = subprocess.run([sys.executable, script, "90"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [line.split() for line in done.stdout.splitlines()]
    kinds = ("sums_kernel", "coefficients_kernel", "apply_kernel")
    assert Counter(name for name, _ in lines) == {f"{pass_}{kind}": 2 for pass_ in ("", "gradient_") for kind in kinds}
    assert all(int(size) > 1000 for _, size in lines)
