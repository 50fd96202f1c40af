"""Kernels as machine code of a GPU that need not be there: what scripts that compile them, and their tests, share."""

import os
import subprocess
import sys
from pathlib import Path

HOPPER = "90"


def compiled_for_hopper(script: Path) -> list[list[str]]:
    """The words of each line that a compiling script prints.

    It has a process of its own, since this one's kernels may be the interpreter's, and without the types' import hook.
    """
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1] / "src")}
    done = subprocess.run([sys.executable, script, HOPPER], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return [line.split() for line in done.stdout.splitlines()]
