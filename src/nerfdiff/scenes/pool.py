"""Share scenes among processes, one Mitsuba thread each."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait

from nerfdiff.errors import DataError
from nerfdiff.scenes.mitsuba_renderer import MitsubaRenderer
from nerfdiff.scenes.scene_job import SceneJob

_renderer: MitsubaRenderer | None = None


def process_count(wanted: int | str, variant: str) -> int:
    """`auto` is one per core; a GPU is one device, which a single process keeps busy."""
    if wanted != "auto":
        return int(wanted)
    if not variant.startswith("scalar"):
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def render_all(jobs: Sequence[SceneJob], processes: int, renderer: tuple[str, int, int]) -> Iterator[int]:
    """Render and write `jobs`; yields the number of images as each scene is complete.

    Args:
        jobs: scenes, started in this order.
        processes: 1 renders in this process.
        renderer: arguments of `MitsubaRenderer`.

    Raises:
        DataError: a scene cannot be written, or a worker process was killed.
    """
    if processes == 1:
        alone = MitsubaRenderer(*renderer)
        yield from (job.render(alone) for job in jobs)
        return
    # spawn: Mitsuba's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _start_worker, renderer) as pool:
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


def _start_worker(variant: str, resolution: int, samples_per_pixel: int) -> None:
    global _renderer
    # Ctrl-C is the parent's to handle; should the parent be killed, nobody is left to work for.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    _renderer = MitsubaRenderer(variant, resolution, samples_per_pixel)


def _leave_with_parent() -> None:
    wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def _work(job: SceneJob) -> int:
    return job.render(_renderer)
