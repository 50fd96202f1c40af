"""Files that rows name: rows may be from strangers, and are believed only of what lies within the results."""

from collections.abc import Iterable
from pathlib import Path


def inside(roots: Iterable[Path], *parts: str | Path) -> Path | None:
    """The path of `parts` if it is there and, wherever links lead, within one of the folders `roots`; else None."""
    try:
        path = Path(*parts)
        real = path.resolve(strict=True)
        return path if any(real.is_relative_to(root.resolve()) for root in roots) else None
    except (OSError, ValueError, RuntimeError):  # not there, no name of a file, links in a circle
        return None
