"""The jobs of a sweep in a file, for its table and for who wants to know what is still to come."""

import json
from collections.abc import Sequence
from pathlib import Path

from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import write_text

PLAN = "plan.json"


def write_plan(folder: Path, jobs: Sequence[Sequence[str]]) -> None:
    """Save the overrides of each job in the sweep's folder."""
    write_text(folder / PLAN, json.dumps({"jobs": [list(job) for job in jobs]}, indent=1) + "\n")


def read_plan(folder: Path) -> list[tuple[str, ...]]:
    """The overrides of each job; none where no sweep has begun.

    Raises:
        DataError: the file is damaged.
    """
    path = folder / PLAN
    try:
        jobs = json.loads(path.read_text(encoding="utf-8"))["jobs"]
        if not all(isinstance(job, list) and all(isinstance(word, str) for word in job) for job in jobs):
            raise ValueError("a job is to be a list of overrides")
        return [tuple(job) for job in jobs]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read ({error}); delete it and run the sweep again") from error
