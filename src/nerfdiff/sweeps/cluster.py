"""Jobs that a cluster runs through submitit, some of which die while others still wait in the queue."""

import logging
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher

from nerfdiff.stopping import Stopped

log = logging.getLogger(__name__)


class JobDied(RuntimeError):
    """A job ended without a word: killed, out of memory, out of time, or with its node."""


@contextmanager
def every_result(launcher: Launcher) -> Iterator[None]:
    """Let a launcher of submitit return what became of each job, the dead ones' being `JobDied`.

    By itself it raises the first death, while other jobs still run: who then runs again what left no row runs these
    twice. Where the sweep is stopped, what is left of its jobs is cancelled, as the same command runs it again.
    """
    if not type(launcher).__module__.startswith("hydra_plugins.hydra_submitit_launcher"):
        yield
        return
    import submitit  # slow, and not there without the extra

    wait, seen = submitit.Job.results, []

    def results(job: submitit.Job) -> list[Any]:
        seen.append(job)
        try:
            return wait(job)
        except Exception as error:
            words = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            died = JobDied(f"job {job.job_id} ended as {job.state}: {words}")
            return [JobReturn(overrides=[], status=JobStatus.FAILED, _return_value=died)]

    try:
        with patch.object(submitit.Job, "results", results):
            yield
    except (Stopped, KeyboardInterrupt):
        for array in {job.job_id.partition("_")[0]: job for job in seen if isinstance(job, submitit.SlurmJob)}:
            subprocess.call(["scancel", array])
            log.warning("job %s is cancelled", array)
        raise
