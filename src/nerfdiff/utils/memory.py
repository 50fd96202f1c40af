"""Memory: how much is free, the peak, and a setting that keeps freed memory with the process.

PyTorch is imported where it is needed: every command imports this module.
"""

import ctypes
import resource
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

# of <malloc.h>
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3


def keep_freed_memory() -> None:
    """Ask glibc not to hand large blocks back to the kernel whenever a tensor dies.

    By default it does, and the next tensor of that size is given zeroed pages one fault at a time, which costs more
    than most operators that fill it. Elsewhere than on glibc nothing changes.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, TypeError):  # another C library, another system
        return
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    # old versions take no more than 32 MiB
    if not mallopt(M_MMAP_THRESHOLD, 2**30):
        mallopt(M_MMAP_THRESHOLD, 2**25)


def forget_peak_memory() -> None:
    """Hand back what is free, and have the kernel count the process's peak from here on: another job begins.

    Elsewhere than on Linux with glibc nothing changes.
    """
    with suppress(AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # man 5 proc: resets the peak resident set size


def peak_memory() -> int:
    """The process's largest resident set in bytes, since it began or `forget_peak_memory` was called."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM:")).split()[1])
    # counts the process that started this one as well
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def free_memory(device: Any) -> int:
    """Bytes that a new process could take now on `device`, a `torch.device`."""
    import torch

    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
