"""Block sizes: chosen by trial on a GPU, once per kernel, sizes and order of magnitude of the work."""

from collections.abc import Callable, Sequence

import torch
import triton

from nerfdiff.render.kernels.merge import merge_kernel

INTERPRETED = not isinstance(merge_kernel, triton.JITFunction)
"""Whether TRITON_INTERPRET was set when kernels were first imported: they then run on any device, slowly."""

PROGRAMS_PER_MULTIPROCESSOR = 4
"""Programs of the backward pass, which each keep sums of the decoder's gradients."""

_KEY = ("size_class", "C", "HIDDEN", "PRECISION", "PLANES", "DECODER", "RAYS")


class Launch:
    """A kernel over (blocks of R rays, scenes).

    Args:
        kernel: with R and S, rays and samples of a tile, among its constants.
        blocks: (R, S, warps) to try; the first is used without trial where results must not depend on a clock.
        interpreted: (R, S) of the interpreter.
        added_to: arguments that the kernel adds to, which trials must not change.
    """

    def __init__(
        self,
        kernel: Callable,
        blocks: Sequence[tuple[int, int, int]],
        interpreted: tuple[int, int],
        added_to: Sequence[str] = (),
    ):
        self.kernel, self.blocks = kernel, tuple(blocks)
        if not INTERPRETED:
            # One stage: gathers feed products through arithmetic, and copies kept in flight would fill shared memory.
            configs = [triton.Config({"R": r, "S": s}, num_warps=warps, num_stages=1) for r, s, warps in blocks]
            key = [name for name in _KEY if name in kernel.arg_names]
            self._tuned = triton.autotune(configs, key, restore_value=list(added_to), cache_results=True)(kernel)
            self._block = configs[0].all_kwargs()
        else:
            self._tuned, self._block = None, dict(zip("RS", interpreted, strict=True))

    def __call__(self, grid: Callable[[dict], tuple], fixed: bool, **arguments) -> None:
        """Run the kernel on the programs that `grid` counts for its constants.

        Args:
            fixed: use the first block sizes, whatever the clock says: sums come in the same order in every process.
        """
        if fixed or self._tuned is None:
            self.kernel[grid](**arguments, **self._block)
        else:
            self._tuned[grid](**arguments)


def size_class(points: int) -> int:
    """The order of magnitude that block sizes are chosen for."""
    return min(points.bit_length(), 24)


def programs_per_scene(device: torch.device, scenes: int, rays: int) -> int:
    """Programs of the backward pass for each scene, at most one for every four rays: fixed by device and sizes."""
    if device.type == "cpu":
        return 2  # the interpreter's programs come one after the other; two show that their sums are kept apart
    multiprocessors = torch.cuda.get_device_properties(device).multi_processor_count
    return max(1, min(triton.cdiv(PROGRAMS_PER_MULTIPROCESSOR * multiprocessors, scenes), triton.cdiv(rays, 4)))
