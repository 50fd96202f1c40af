"""Kernels become machine code of a GPU that need not be there: what the interpreter runs must compile as well."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton.backends.nvidia")

ROOT = Path(__file__).parents[2]
KERNELS = ("look, uniform", "look, drawn", "draw", "composite", "composite_gradient", "gradient", "gradient, by runs")
BOUNDS = {"look, uniform": (60, 100), "look, drawn": (60, 90), "gradient": (100, 350), "gradient, by runs": (100, 500)}
"""Of warp instructions for each point: sm_80 adds to memory number by number, and has the most of a gradient."""
FRAME = 16
"""Bytes of a thread's stack where nothing is spilled, at most."""
SPILLED = 512
"""Likewise in fp32 with everything asked for, and where a run's sums take up the registers."""


@pytest.mark.parametrize("words", [("90", "--exact"), ("80",), ("100",)], ids=" ".join)
def test_every_kernel_compiles_as_it_is_launched(words):
    """In a process of its own, since this one's kernels may be the interpreter's."""
    command = [sys.executable, ROOT / "benchmarks" / "instructions.py", "--capability", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    halves, *exact = [block.splitlines()[2:] for block in done.stdout.split("| kernel |")[1:]]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in halves if line.startswith("|")]
    assert {row[0] for row in rows} == set(KERNELS)
    for name, _, _, stack, warps, instructions, requested in rows:
        if name != "gradient, by runs" and "80" not in words:
            assert int(stack) <= FRAME and int(warps) > 8, name
        assert int(stack) <= SPILLED and int(warps) >= 8, name
        least, most = BOUNDS.get(name, (1, 10))
        assert least < float(instructions) < most and float(requested) > 10, (name, instructions)
    assert "an inner step of 4096 rays at perfect issue" in done.stdout
    assert len(exact) == ("--exact" in words)
    for line in exact[0] if exact else ():
        assert not line.startswith("|") or int(line.split("|")[4]) <= SPILLED, line
