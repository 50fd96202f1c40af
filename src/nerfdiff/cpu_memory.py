"""Freed memory stays with the process, for the next tensors."""

import ctypes

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
