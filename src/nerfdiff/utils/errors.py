"""The errors a person can mend: each message names what failed, what was expected and what to do."""

import math
from collections.abc import Collection


class UserError(Exception):
    """Base of every error whose cause is input; entry points print it as one line, with no traceback."""


class DataError(UserError, ValueError):
    """A dataset file or folder is missing, damaged or not in the expected layout."""


class BackgroundError(DataError):
    """A picture does not tell its object from the background."""


class ConfigError(UserError, ValueError):
    """A configuration key or value is not one the program knows."""


class CheckpointError(UserError, RuntimeError):
    """A checkpoint cannot be read, written, or does not fit the configuration."""


class TrainingDiverged(UserError, RuntimeError):
    """Losses or gradients stayed non-finite for too many steps in a row."""


class BusyError(UserError, RuntimeError):
    """Another process works in the same folder."""


class ProcessLost(UserError, RuntimeError):
    """One of the processes that share a run died."""


class OutOfMemory(UserError, MemoryError):
    """More memory was asked for than the device has free."""


class TimeUp(UserError):
    """A run ended because the minutes it may take were spent, with work left to do."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return true if a device's memory ran out; PyTorch says so of a CPU's in words only."""
    words = "can't allocate memory", "not enough memory", "CUDA out of memory"
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(w in str(error) for w in words))


def size_text(count: float) -> str:
    """Bytes as a person reads them: `512 bytes`, `3.4 MB`."""
    power = min(4, int(math.log10(max(count, 1)) / 3))
    value, unit = count / 1000**power, ("bytes", "kB", "MB", "GB", "TB")[power]
    return f"{value:.0f} {unit}" if power == 0 or value >= 100 else f"{value:.3g} {unit}"


def some(names: Collection[str], limit: int = 8) -> str:
    """The first few of these names, and how many more there are."""
    names = sorted(names)
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return (", ".join(names[:limit]) or "none") + more
