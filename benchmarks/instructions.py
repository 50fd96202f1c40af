"""What the renderer's kernels cost, counted from their machine code: no GPU is needed.

    python benchmarks/instructions.py
    python benchmarks/instructions.py --capability 80

Every kernel is compiled ahead of time. Instructions of a loop count as often as it runs; all branches count as taken.
"Perfect issue" is one warp instruction per scheduler and cycle: 132 multiprocessors of 4 schedulers at 1.755 GHz (H100).
"""

import argparse
import os
import re
import subprocess
import tempfile
from dataclasses import dataclass

os.environ.pop("TRITON_INTERPRET", None)  # before triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.merge import merge_kernel

ISSUES = 132 * 4 * 1.755e9
"""Warp instructions per second."""
SIZES = {"C": 48, "CP": 64, "HIDDEN": 64, "HP": 64}
UNIFORM, DRAWN, VIEW, RAYS = 64, 64, 128**2, 4096
INTEGERS = {"n", "first", "count", "samples", "drawn", "jitters", "height", "width", "points", "size_class"}
FLOATS = {"image_width", "image_height", "shift", "scale", "background", "floor"}
POINTERS = {"cells": "*i32", "order": "*i64", "starts": "*i64"}


@dataclass(frozen=True)
class Code:
    """A kernel as machine code."""

    cubin: bytes
    shared: int
    warps: int

    def _said(self, *words: str) -> str:
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(self.cubin)
            file.flush()
            return subprocess.run([*words, file.name], capture_output=True, text=True, check=True).stdout

    def resources(self) -> tuple[int, int]:
        """Registers of a thread, and bytes of its stack, to which registers spill."""
        said = self._said(triton.knobs.nvidia.cuobjdump.path, "-res-usage")
        return tuple(int(re.search(rf"{name}:(\d+)", said)[1]) for name in ("REG", "STACK"))

    def warps_per_multiprocessor(self) -> int:
        """Of 64 at most, in 32 programs: 65536 registers and 227 KiB of shared memory are shared."""
        of_warp = -(-self.resources()[0] * 32 // 256) * 256
        programs = min(65536 // (of_warp * self.warps), 32, 64 // self.warps)
        return self.warps * min(programs, 227 * 1024 // (self.shared + 1024))

    def instructions(self, trips: tuple[float, ...]) -> float:
        """That a warp issues, if loops run so many times: the outermost first."""
        at, jumps = [], []
        for line in self._sass():
            at.append(line[0])
            if line[1] is not None:
                jumps.append((line[1], line[0]))
        loops = [(first, last) for first, last in jumps if first < last]
        total = 0.0
        for place in at:
            depth = len({first for first, last in loops if first <= place <= last})
            count = 1.0
            for trip in trips[:depth]:
                count *= trip
            total += count
        return total

    def _sass(self) -> list[tuple[int, int | None]]:
        """Of each instruction its address, and where it jumps to."""
        said = self._said(triton.knobs.nvidia.cuobjdump.path, "-sass")
        found = []
        for line in said.splitlines():
            match = re.match(r"\s+/\*([0-9a-f]{4,})\*/\s+(.*?);", line)
            if match and "NOP" not in match[2]:
                jump = re.search(r"\bBRA\b.*?(0x[0-9a-f]+)", match[2])
                target = int(jump[1], 16) if jump else None
                place = int(match[1], 16)
                # what follows the last return is a loop onto itself
                found.append((place, None if target == place else target))
        return found


def compiled(kernel, capability: int, warps: int, planes: str = "*bf16", weights: str = "*fp32", **constants) -> Code:
    """Machine code of a kernel; `planes` and `weights` are types of these pointers."""
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
    made = triton.compile(source, target=target, options={"num_warps": warps, "num_stages": 1})
    return Code(made.asm["cubin"], made.metadata.shared, warps)


def counted(name: str, kernel, block, per_program, trips, capability: int, **constants) -> float:
    """Print a row of the table; warp instructions per point."""
    rays, samples, warps = block
    sizes = {**SIZES, "R": rays, "S": samples, "PRECISION": "bf16", "SHARED": False} | constants
    code = compiled(
        kernel, capability, warps, **{k: v for k, v in sizes.items() if k in kernel.arg_names}
    )
    registers, stack = code.resources()
    per_point = code.instructions(trips) * warps / per_program
    occupied = code.warps_per_multiprocessor()
    print(f"| {name} | {block} | {registers} / {stack} | {occupied} | {per_point:.1f} |", flush=True)
    return per_point


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--capability", type=int, default=90)
    capability = arguments.parse_args().capability
    print("| kernel | block | registers / stack | warps per SM | warp instructions per point |\n|---|---|---|---|---|")
    inner = {"JITTER": True, "OPAQUE": False, "PLANES": "atomic", "DECODER": True, "RAYS": False}
    samples = UNIFORM + DRAWN
    best = {}
    for name, launch in (("coarse", passes._coarse), ("composite", passes._composite), ("gradient", passes._gradient)):
        walked = UNIFORM if name == "coarse" else samples
        for block in launch.blocks:
            trips = (walked / block[1], 3) if name != "gradient" else (1, walked / block[1], 3)
            found = counted(name, launch.kernel, block, block[0] * walked, trips, capability, **inner)
            best[name] = min(best.get(name, found), found)
    best["merge"] = counted("merge", merge_kernel, (16, 1, 4), 16 * samples, (UNIFORM,), capability,
                            JITTER=True, EVEN=False, DP=64, R=16)
    look = UNIFORM * best["coarse"] + samples * (best["composite"] + best["merge"])
    step = look + UNIFORM * best["coarse"] + samples * (best["gradient"] + best["merge"])
    for what, rays, cost in (("a view of 128 x 128", VIEW, look), (f"an inner step of {RAYS} rays", RAYS, step)):
        print(f"{what} at perfect issue: {rays * cost / 1e6:.0f} M warp instructions, {1e3 * rays * cost / ISSUES:.2f} ms")


if __name__ == "__main__":
    main()
