"""Compile every kernel to machine code of a GPU that need not be there; print each one's name and its size in bytes.

python tests/render/compile_kernels.py [compute capability, as 90] [channels] [hidden]
"""

import os
import sys

os.environ.pop("TRITON_INTERPRET", None)  # before triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from nerfdiff.render.kernels.cells import cells_kernel
from nerfdiff.render.kernels.coarse import coarse_kernel
from nerfdiff.render.kernels.composite import composite_kernel
from nerfdiff.render.kernels.gradient import gradient_kernel
from nerfdiff.render.kernels.merge import merge_kernel

POINTERS = {"cells": "*i32", "order": "*i64", "starts": "*i64"}
FLOATS = {"image_width", "image_height", "shift", "scale", "background", "floor"}
INTEGERS = {"n", "first", "count", "samples", "drawn", "jitters", "height", "width", "points", "size_class"}


def compile_one(kernel, capability: int, planes: str, warps: int, weights: str = "*fp32", **constants) -> str:
    """Name and size of the machine code.

    Args:
        planes, weights: types of these pointers.
    """
    signature = {}
    for parameter in kernel.params:
        name = parameter.name
        kind = "constexpr" if parameter.is_constexpr else "fp32" if name in FLOATS else "*fp32"
        kind = "i32" if name in INTEGERS else {"planes": planes, "weights": weights, **POINTERS}.get(name, kind)
        signature[name] = kind
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants)
    target = GPUTarget("cuda", capability, 32)
    compiled = triton.compile(source, target=target, options={"num_warps": warps, "num_stages": 1})
    return f"{kernel.__name__} {len(compiled.asm['cubin'])} {compiled.metadata.shared}"


def compile_all(capability: int = 90, channels: int = 12, hidden: int = 16) -> None:
    """One variant of each kernel and product."""
    padded = {name: max(16, triton.next_power_of_2(size)) for name, size in (("CP", channels), ("HP", hidden))}
    field = {"SHARED": False, "C": channels, "HIDDEN": hidden, "R": 2, "S": 16} | padded
    variants = (("bf16", "*bf16", "atomic", False), ("tf32x3", "*fp32", "ordered", True))
    for precision, planes, how, opaque in variants:
        common = {"PRECISION": precision, **field}
        print(compile_one(composite_kernel, capability, planes, 4, OPAQUE=opaque, **common))
        asked = {"PLANES": how, "DECODER": True, "RAYS": True}
        print(compile_one(gradient_kernel, capability, planes, 4, OPAQUE=opaque, **asked, **common))
    print(compile_one(coarse_kernel, capability, "*bf16", 4, JITTER=True, PRECISION="bf16", **field))
    for weights, even in (("*fp32", False), ("*fp16", True)):
        print(compile_one(merge_kernel, capability, "", 4, weights, JITTER=True, EVEN=even, DP=64, R=16))
    print(compile_one(cells_kernel, capability, "", 1, C=channels, CP=padded["CP"], P=16))


if __name__ == "__main__":
    compile_all(*map(int, sys.argv[1:]))
