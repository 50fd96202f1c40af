"""Which of the processes of one run this is."""

import os

_known: list[int] = []


def set_rank(rank: int) -> None:
    """Say which process this is, where a launcher other than ours started it."""
    _known[:] = [rank]


def is_first() -> bool:
    """Return true in the process that speaks and writes for all: those that it launched have a LOCAL_RANK."""
    return (_known[0] if _known else int(os.environ.get("LOCAL_RANK", 0))) == 0
