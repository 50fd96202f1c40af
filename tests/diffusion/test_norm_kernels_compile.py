"""Kernels become machine code of a GPU that need not be there: what the interpreter runs must compile as well."""

from collections import Counter
from pathlib import Path

import pytest

from cross_compiling import compiled_for_hopper

pytest.importorskip("triton.backends.nvidia")


def test_every_norm_kernel_compiles_for_hopper():
    lines = compiled_for_hopper(Path(__file__).with_name("compile_norm_kernels.py"))
    kinds = ("sums_kernel", "coefficients_kernel", "apply_kernel")
    assert Counter(name for name, _ in lines) == {f"{pass_}{kind}": 2 for pass_ in ("", "gradient_") for kind in kinds}
    assert all(int(size) > 1000 for _, size in lines)
