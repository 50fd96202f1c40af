"""Costs of the renderer's kernels, counted from their machine code: no GPU is needed.

    python benchmarks/instructions.py
    python benchmarks/instructions.py --capability 80 90 100 --exact

Every kernel is compiled ahead of time, for 64 hidden units, planes of 128 x 128 and 64 + 64 samples, all of which are
looked at. Of the loops at one depth the longest runs as often as there is work, the others (remainders) once; all
branches count as taken. Bytes are those that instructions ask for, wherever they are. "Perfect issue" is one warp
instruction per scheduler and cycle: 132 multiprocessors of 4 schedulers at 1.755 GHz (H100).
"""

import argparse
import os
import re
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cached_property

os.environ.pop("TRITON_INTERPRET", None)  # before triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from nerfdiff.render.kernels import composite, passes
from nerfdiff.render.kernels.cells import cells_kernel
from nerfdiff.render.kernels.draw import draw_kernel

ISSUES = 132 * 4 * 1.755e9
"""Warp instructions per second."""
UNIFORM, DRAWN, VIEW, STEP = 64, 64, 128**2, 4096
SAMPLES = UNIFORM + DRAWN
INTEGERS = {"n", "first", "count", "uniform", "drawn", "samples", "jitters", "segment", "points", "size_class"}
INTEGERS |= {"height", "width"}
FLOATS = {"image_width", "image_height", "shift", "scale", "background", "floor", "bound"}
POINTERS = {"cells": "*i32", "order": "*i64", "starts": "*i64"}
HALF = {"HIDDEN": 64, "HP": 64, "H": 128, "W": 128, "UP": UNIFORM, "DP": DRAWN, "SHARED": False, "HALF": True}
HALF |= {
    "STOP": True,
    "JITTER": True,
    "OPAQUE": False,
    "EVEN": False,
    "TABLE": "atomic",
    "DECODER": True,
    "RAYS": False,
}
EXACT = {"HALF": False, "OPAQUE": True, "EVEN": True, "JITTER": False, "TABLE": "ordered", "RAYS": True, "STOP": False}
"""Compile-time options with all other features on."""


@dataclass(frozen=True)
class Code:
    """A kernel as machine code of programs of so many warps, and bytes of their shared memory."""

    cubin: bytes
    shared: int
    warps: int

    def _said(self, option: str) -> str:
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(self.cubin)
            file.flush()
            words = [triton.knobs.nvidia.cuobjdump.path, option, file.name]
            return subprocess.run(words, capture_output=True, text=True, check=True).stdout

    @cached_property
    def resources(self) -> tuple[int, int]:
        """Registers of a thread, and bytes of its stack, to which registers spill."""
        said = self._said("-res-usage")
        return int(re.search(r"REG:(\d+)", said)[1]), int(re.search(r"STACK:(\d+)", said)[1])

    @property
    def warps_per_multiprocessor(self) -> int:
        """Return warps that fit a multiprocessor: up to 64 in 32 programs, with 65536 registers and 227 KiB for all."""
        of_warp = -(-self.resources[0] * 32 // 256) * 256
        programs = min(65536 // (of_warp * self.warps), 32, 64 // self.warps)
        return self.warps * min(programs, 227 * 1024 // (self.shared + 1024))

    @cached_property
    def _instructions(self) -> list[tuple[int, str]]:
        """Each one's address and words, but for what lanes that came apart do to share numbers, which is rare."""
        found = re.findall(r"^\s+/\*([0-9a-f]{4,})\*/\s+(.*?);", self._said("-sass"), re.MULTILINE)
        numbers = {int(place, 16): number for number, (place, _) in enumerate(found)}
        reached, ahead = set(), [0]
        while ahead:
            number = ahead.pop()
            if number in reached:
                continue
            reached.add(number)
            words = found[number][1]
            if (target := _target(words)) is not None:
                ahead.append(numbers[target])
            if not re.fullmatch(r"EXIT|BRA(\.\w+)? 0x[0-9a-f]+", words.strip()):
                ahead.append(number + 1)
        return [(int(found[number][0], 16), found[number][1]) for number in sorted(reached)]

    def issued(self, trips: tuple[float, ...]) -> tuple[float, float]:
        """Instructions of a warp, and bytes that they ask memory for.

        Args:
            trips: how often the longest loop runs at each depth, from the outermost on.
        """
        jumps = [(_target(words), place) for place, words in self._instructions]
        loops = [(target, place) for target, place in jumps if target is not None and target < place]

        def around(place: int) -> list[tuple[int, int]]:
            return sorted(((a, b) for a, b in loops if a <= place <= b), key=lambda loop: loop[0] - loop[1])

        depths: dict[int, list[tuple[int, int]]] = {}
        for loop in loops:
            depths.setdefault(len(around(loop[1])), []).append(loop)
        longest = {depth: max(those, key=lambda loop: loop[1] - loop[0]) for depth, those in depths.items()}
        number = requested = 0.0
        for place, words in self._instructions:
            times = 1.0
            for depth, loop in enumerate(around(place), 1):
                times *= trips[depth - 1] if longest[depth] == loop and depth <= len(trips) else 1
            number += times
            if match := re.search(r"\b(?:LDG|STG|REDG|RED|ATOMG)\.(\S+)", words):
                size = re.search(r"\b(128|64|16|8)\b|x([24])", match[1].replace("U16", "16"))
                requested += times * 32 * (4 if size is None else int(size[1] or 32 * int(size[2])) / 8)
        return number, requested


def _target(words: str) -> int | None:
    """Return the address an instruction jumps to; None for jumps of diverged lanes."""
    found = re.search(r"\bBRA\b(?!\.DIV).*?(0x[0-9a-f]+)", words)
    return int(found[1], 16) if found else None


def compiled(kernel, capability: int, constants: dict) -> Code:
    """Machine code of a kernel as it is launched on tensors."""
    signature, aligned = {}, {}
    for place, parameter in enumerate(kernel.params):
        name = parameter.name
        table = "*fp16" if constants["HALF"] else "*fp32"
        kind = "constexpr" if parameter.is_constexpr else "fp32" if name in FLOATS else "*fp32"
        signature[name] = "i32" if name in INTEGERS else {"table": table, **POINTERS}.get(name, kind)
        if signature[name].startswith("*"):
            aligned[(place,)] = [["tt.divisibility", 16]]
    there = {name: value for name, value in constants.items() if name in kernel.arg_names}
    source = ASTSource(fn=kernel, signature=signature, constexprs=there, attrs=aligned)
    options = {"num_warps": constants["num_warps"]}
    made = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    return Code(made.asm["cubin"], made.metadata.shared, constants["num_warps"])


def launches() -> list[tuple]:
    """(name, kernel, constants, points per program, trips of its loops) of all that a step launches."""
    walk, draw = {"R": passes.RAYS, "num_warps": 1}, {"R": max(1, 128 // DRAWN), "num_warps": 1}
    found = []
    for name, first, points in (("look, uniform", True, UNIFORM), ("look, drawn", False, passes.SEGMENT)):
        for block in passes._look.blocks:
            found.append(
                (name, passes._look.kernel, {**block, "FIRST": first}, block["R"] * points, (points / block["S"],))
            )
    found.append(("draw", draw_kernel, draw, draw["R"] * SAMPLES, (UNIFORM.bit_length() - 1,)))
    for name in ("composite", "composite_gradient"):
        found.append((name, getattr(composite, f"{name}_kernel"), walk, walk["R"] * SAMPLES, (SAMPLES,)))
    for block in passes._gradient.blocks:
        points = block["R"] * passes.SEGMENT
        name = "gradient, by runs" if block["RUNS"] else "gradient"
        found.append((name, passes._gradient.kernel, block, points, (1, passes.SEGMENT)))
    return found


def count(capability: int, exact: bool) -> dict[str, float]:
    """Print a table; warp instructions per point by kernel, of its first block."""
    print(f"sm_{capability}, {'fp32, all that can be asked for' if exact else 'halves'}, Triton {triton.__version__}\n")
    print("| kernel | block | registers | stack | warps per SM | warp instructions per point | bytes per point |")
    print("|---|---|---|---|---|---|---|")
    costs: dict[str, float] = {}
    for name, kernel, block, points, trips in launches():
        code = compiled(kernel, capability, HALF | (EXACT if exact else {}) | block)
        number, requested = (code.warps * value / points for value in code.issued(trips))
        costs.setdefault(name, number)
        shown = " ".join(f"{key}={value}" for key, value in block.items() if key != "FIRST")
        numbers = f"{code.resources[0]} | {code.resources[1]} | {code.warps_per_multiprocessor}"
        print(f"| {name} | {shown} | {numbers} | {number:.1f} | {requested:.0f} |", flush=True)
    return costs


def main(words: list[str] | None = None) -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--capability", type=int, nargs="+", default=[90], help="compute capability, as 90")
    arguments.add_argument("--exact", action="store_true", help="fp32 kernels too, with every option")
    chosen = arguments.parse_args(words)
    for capability in chosen.capability:
        costs = count(capability, False)
        view = UNIFORM * costs["look, uniform"] + DRAWN * costs["look, drawn"]
        view += SAMPLES * (costs["draw"] + costs["composite"])
        step = view + SAMPLES * (costs["composite_gradient"] + costs["gradient"])
        for what, rays, cost in (("a view of 128 x 128", VIEW, view), (f"an inner step of {STEP} rays", STEP, step)):
            issued = f"{rays * cost / 1e6:.0f} M warp instructions, {1e3 * rays * cost / ISSUES:.3f} ms"
            print(f"\n{what} at perfect issue: {issued}")
        if chosen.exact:
            print()
            count(capability, True)
            code = compiled(cells_kernel, capability, {"HALF": False, "C": 64, "CP": 64, "P": 16, "num_warps": 1})
            print(f"| cells | P=16 num_warps=1 | {code.resources[0]} | {code.resources[1]} | | | |", flush=True)
        print()


if __name__ == "__main__":
    main()
