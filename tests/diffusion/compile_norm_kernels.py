"""Compile every kernel of the fused GroupNorm to machine code of a GPU that need not be there; print names and sizes.

python tests/diffusion/compile_norm_kernels.py [compute capability, as 90] [channels]
"""

import os
import sys

os.environ.pop("TRITON_INTERPRET", None)  # before triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from nerfdiff.diffusion.kernels.norm_silu import apply_kernel, coefficients_kernel, sums_kernel
from nerfdiff.diffusion.kernels.norm_silu_gradient import (
    gradient_apply_kernel,
    gradient_coefficients_kernel,
    gradient_sums_kernel,
)

IMAGES = {"x", "gradient", "out", "scale_shift", "d_scale_shift"}
NUMBERS = {"pixels": "i32", "parts": "i32", "eps": "fp32"}
GROUPS = 32


def compile_one(kernel, capability: int, images: str, **constants) -> str:
    """Name and size of the machine code.

    Args:
        images: type of the pointers to images and of what autocast brings beside them.
    """
    signature = {}
    for parameter in kernel.params:
        name = parameter.name
        kind = images if name in IMAGES else NUMBERS.get(name, "*fp32")
        signature[name] = "constexpr" if parameter.is_constexpr else kind
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants)
    compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options={"num_warps": 4})
    return f"{kernel.__name__} {len(compiled.asm['cubin'])}"


def compile_all(capability: int = 90, channels: int = 96) -> None:
    """Each kernel in bf16 with all that it can do, and in fp32 with as little."""
    padded = triton.next_power_of_2(channels)
    tile = {"C": channels, "CP": padded, "R": 4096 // padded}
    size = channels // GROUPS
    groups = {"GROUPS": GROUPS, "SIZE": size, "SP": triton.next_power_of_2(size)}
    for images, most in (("*bf16", True), ("*fp32", False)):
        work = [
            (sums_kernel, {"STEPS": 8, **tile}),
            (coefficients_kernel, {"MODULATED": most, **groups}),
            (apply_kernel, {"ACTIVE": most, **tile}),
            (gradient_sums_kernel, {"ACTIVE": most, "STEPS": 8, **tile}),
            (gradient_coefficients_kernel, {"MODULATED": most, "AFFINE": most, "MODULATION": most, **groups}),
            (gradient_apply_kernel, {"ACTIVE": most, **tile}),
        ]
        for kernel, constants in work:
            print(compile_one(kernel, capability, images, **constants))


if __name__ == "__main__":
    compile_all(*map(int, sys.argv[1:]))
