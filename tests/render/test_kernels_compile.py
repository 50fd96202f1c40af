"""Kernels become machine code of a GPU that need not be there: what the interpreter runs must compile as well."""

from pathlib import Path

import pytest

from cross_compiling import compiled_for_hopper

pytest.importorskip("triton.backends.nvidia")


SHARED = 227 * 1024
"""Bytes that a program may have on Hopper."""
STACK = {
    ("coarse_kernel", "bf16"): (0, 0),
    ("composite_kernel", "bf16"): (0, 0),
    ("gradient_kernel", "bf16"): (0, 216),
    ("coarse_kernel", "tf32x3"): (160, 144),
    ("composite_kernel", "tf32x3"): (144, 144),
    ("gradient_kernel", "tf32x3"): (664, 1776),
}
"""Bytes to which registers of a thread spill, in the first block of a list and in the largest: the more of Triton 3.6
and 3.8. bf16 is what a model of base size is distilled in."""
MORE = 96
"""Bytes that other compilers may take beside."""


def test_every_kernel_compiles_for_hopper_as_it_is_launched():
    lines = compiled_for_hopper(Path(__file__).with_name("compile_kernels.py"))
    assert {name for name, *_ in lines} == {name for name, _ in STACK} | {"cells_kernel", "merge_kernel"}
    assert all(int(size) > 1000 and int(shared) <= SHARED for *_, size, shared, _ in lines)
    for (kernel, precision), bounds in STACK.items():
        taken = [int(stack) for name, _, kind, *_, stack in lines if (name, kind) == (kernel, precision)]
        assert len(taken) == 2
        assert all(own <= bound + MORE for own, bound in zip(taken, bounds, strict=True)), (kernel, precision, taken)
