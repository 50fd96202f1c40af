"""Compile every kernel as it is launched to machine code of a GPU that need not be there.

python tests/render/compile_kernels.py [compute capability, as 90]

For each: name, block, precision, channels; and bytes of code, of a program's shared memory, and of a thread's stack,
to which registers spill.
"""

import os
import re
import subprocess
import sys
import tempfile

os.environ.pop("TRITON_INTERPRET", None)  # before triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.cells import cells_kernel
from nerfdiff.render.kernels.merge import merge_kernel

POINTERS = {"cells": "*i32", "order": "*i64", "starts": "*i64"}
FLOATS = {"image_width", "image_height", "shift", "scale", "background", "floor"}
INTEGERS = {"n", "first", "count", "samples", "drawn", "jitters", "height", "width", "points", "size_class"}
HIDDEN = 64
"""Of all models."""


def compile_one(kernel, capability: int, planes: str, warps: int, weights: str = "*fp32", **constants) -> str:
    """Bytes of machine code, shared memory and stack.

    Args:
        planes, weights: types of these pointers.
    """
    signature, aligned = {}, {}
    for place, parameter in enumerate(kernel.params):
        name = parameter.name
        kind = "constexpr" if parameter.is_constexpr else "fp32" if name in FLOATS else "*fp32"
        kind = "i32" if name in INTEGERS else {"planes": planes, "weights": weights, **POINTERS}.get(name, kind)
        signature[name] = kind
        if kind.startswith("*"):
            aligned[(place,)] = [["tt.divisibility", 16]]  # as tensors are
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=aligned)
    target = GPUTarget("cuda", capability, 32)
    compiled = triton.compile(source, target=target, options={"num_warps": warps, "num_stages": 1})
    code = compiled.asm["cubin"]
    return f"{len(code)} {compiled.metadata.shared} {stack(code)}"


def stack(code: bytes) -> int:
    """Bytes of a thread's."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(code)
        file.flush()
        words = [triton.knobs.nvidia.cuobjdump.path, "-res-usage", file.name]
        said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    return int(re.search(r"STACK:(\d+)", said)[1])


def compile_launch(launch: passes.Launch, capability: int, precision: str, channels: int, block, **constants) -> None:
    """One kernel over rays, at a block of its list."""
    rays, samples, warps = block
    sizes = {"C": channels, "CP": triton.next_power_of_2(channels), "HIDDEN": HIDDEN, "HP": HIDDEN}
    sizes |= {"R": rays, "S": samples, "PRECISION": precision, "SHARED": False}
    planes = "*bf16" if precision == "bf16" else "*fp32"
    there = {name: value for name, value in (sizes | constants).items() if name in launch.kernel.arg_names}
    told = f"{launch.kernel.__name__} {rays},{samples},{warps} {precision} {channels}"
    print(told, compile_one(launch.kernel, capability, planes, warps, **there), flush=True)


def compile_all(capability: int = 90) -> None:
    """The first block of every list, which is launched untried, and the one with most points: as inner steps launch
    them, and the first also with all that can be asked of it."""
    inner = {"JITTER": True, "OPAQUE": False, "PLANES": "atomic", "DECODER": True, "RAYS": False}
    every = inner | {"OPAQUE": True, "PLANES": "ordered", "RAYS": True}
    for launch in (passes._coarse, passes._composite, passes._gradient):
        first, largest = launch.blocks[0], max(launch.blocks, key=lambda block: block[0] * block[1])
        compile_launch(launch, capability, "bf16", 48, first, **inner)
        compile_launch(launch, capability, "bf16", 48, largest, **inner)
        compile_launch(launch, capability, "tf32x3", 64, first, **every)
        compile_launch(launch, capability, "tf32x3", 64, largest, **inner)
    for weights, even in (("*fp32", False), ("*fp16", True)):
        told = compile_one(merge_kernel, capability, "", 4, weights, JITTER=True, EVEN=even, DP=64, R=16)
        print("merge_kernel 16,64,4", weights, "-", told)
    for channels in (48, 64):
        told = compile_one(cells_kernel, capability, "", 1, C=channels, CP=64, P=16)
        print("cells_kernel 16,1,1 fp32", channels, told)


if __name__ == "__main__":
    compile_all(*map(int, sys.argv[1:]))
