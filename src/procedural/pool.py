"""Share scenes among processes, one Mitsuba thread each."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait

from nerfdiff.utils.errors import DataError
from procedural.kinds.kind import SceneJob, SceneKind
from procedural.mitsuba_renderer import MitsubaRenderer

_worker: tuple[SceneKind, MitsubaRenderer] | None = None


def process_count(wanted: int | str, variant: str) -> int:
    """`auto` is one per core; a GPU is one device, which a single process keeps busy."""
    if wanted != "auto":
        return int(wanted)
    if not variant.startswith("scalar"):
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def render_all(kind: SceneKind, jobs: Sequence[SceneJob], processes: int, variant: str) -> Iterator[int]:
    """Render and write `jobs`; yields the number of images as each scene is complete.

    Args:
        kind: makes the scenes.
        jobs: scenes, started in this order.
        processes: 1 renders in this process.
        variant: a Mitsuba variant, not `auto`.

    Raises:
        DataError: a scene cannot be written, or a worker process was killed.
    """
    if processes == 1:
        alone = MitsubaRenderer(variant, kind.film)
        for job in jobs:
            kind.make(job, alone)
            yield job.views
        return
    # spawn: Mitsuba's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _start_worker, (kind, variant)) as pool:
        futures = [pool.submit(_work, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise DataError(
                "a rendering process was killed (out of memory?); run again to go on, with fewer processes"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _start_worker(kind: SceneKind, variant: str) -> None:
    global _worker
    # Ctrl-C is the parent's to handle; should the parent be killed, nobody is left to work for.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    _worker = kind, MitsubaRenderer(variant, kind.film)


def _leave_with_parent() -> None:
    wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def _work(job: SceneJob) -> int:
    kind, renderer = _worker
    kind.make(job, renderer)
    return job.views
