"""Block sizes: chosen by trial on a GPU, once per kernel, sizes and order of magnitude of the work."""

from collections.abc import Callable, Sequence

import torch
import triton

from nerfdiff.render.kernels.draw import draw_kernel

INTERPRETED = not isinstance(draw_kernel, triton.JITFunction)
"""True if TRITON_INTERPRET was set when kernels were first imported: they then run on any device, slowly."""

WARPS = 16
"""Programs of the backward pass for each multiprocessor, which each keep sums of the decoder's gradients."""

_KEY = ("size_class", "HP", "HALF", "H", "W", "FIRST", "STOP", "TABLE", "DECODER", "RAYS")


class Launch:
    """A kernel over (blocks of R rays, scenes).

    Args:
        kernel: with R, rays of a program, among its constants.
        blocks: constants and warps to try; the first is used without trial where results must not depend on a clock.
        interpreted: constants of the interpreter.
        added_to: arguments that the kernel adds to, which trials must not change.
    """

    def __init__(
        self,
        kernel: Callable,
        blocks: Sequence[dict[str, int]],
        interpreted: dict[str, int],
        added_to: Sequence[str] = (),
    ):
        self.kernel, self.blocks = kernel, tuple(blocks)
        if INTERPRETED:
            self._tuned, self._block = None, interpreted
        else:
            configs = [
                triton.Config({k: v for k, v in block.items() if k != "num_warps"}, num_warps=block["num_warps"])
                for block in self.blocks
            ]
            key = [name for name in _KEY if name in kernel.arg_names]
            self._tuned = triton.autotune(configs, key, restore_value=list(added_to), cache_results=True)(kernel)
            self._block = self.blocks[0]

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


def programs_per_scene(device: torch.device, scenes: int, most: int) -> int:
    """Programs of the backward pass for each scene, `most` at most: fixed by device and sizes."""
    if device.type == "cpu":
        return 2  # the interpreter's programs come one after the other; two show that their sums are kept apart
    multiprocessors = torch.cuda.get_device_properties(device).multi_processor_count
    return max(1, min(triton.cdiv(WARPS * multiprocessors, scenes), most))
