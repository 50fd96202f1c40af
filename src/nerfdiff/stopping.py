"""Signals that end a run: work is saved first, one line says so, and the exit status tells which signal it was.

A scheduler's job that is to give way, or whose time is up, is then put back into its queue: by submitit where that runs
it, else here. Lightning's own way of doing so is switched off.
"""

import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from nerfdiff.utils.rank import is_first

log = logging.getLogger(__name__)

SUBMITIT = "SUBMITIT_EXECUTOR"
GIVE_WAY = (signal.SIGUSR1, signal.SIGUSR2)
"""By which Slurm (`--signal=USR1@120`) and submitit (USR2) say that a job's time is up, or wanted by another."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *GIVE_WAY)


class Stopped(BaseException):
    """A person or a scheduler asked the run to end: no failure, so no `Exception`.

    Args:
        signum: of the signal.
        kept: a sentence on what of the work is saved, where that is known.
    """

    def __init__(self, signum: int, kept: str = ""):
        super().__init__(signum, kept)
        self.signum, self.kept = signum, kept

    @property
    def status(self) -> int:
        """The exit status that shells, make and schedulers expect: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signum

    def __str__(self) -> str:
        by = "Ctrl-C" if self.signum == signal.SIGINT else signal.Signals(self.signum).name
        return f"stopped by {by}. {self.kept}".strip()


@contextmanager
def on_signals(act: Callable[[int], None]) -> Iterator[None]:
    """Call `act` with the number of each signal that asks this process to end, instead of what was to happen.

    Signals that are ignored stay so, as SIGHUP is under nohup. One that comes while the former handlers are put back
    is theirs: a scheduler sends several at once.
    """
    ended, late = False, []

    def handle(signum: int, frame: FrameType | None) -> None:
        if ended:
            late.append(signum)
        else:
            act(signum)

    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        ended = True
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in late:
            signal.raise_signal(number)


def stop(signum: int) -> None:
    """Raise `Stopped`, here and now."""
    raise Stopped(signum)


@contextmanager
def in_a_job() -> Iterator[None]:
    """Within a scheduler's job: stop at signals, also where a launcher took them over, and queue the job again.

    Raises:
        Stopped: as it came; the job is in the queue again, unless it was cancelled. (submitit ends the process itself.)
    """
    try:
        if SUBMITIT in os.environ:  # it lets SIGTERM pass by
            with on_signals(stop):
                yield
        else:
            yield
    except Stopped as stopped:
        if stopped.signum in GIVE_WAY or (stopped.signum == signal.SIGTERM and _is_preempted()):
            _queue_again(stopped)
        raise


def _queue_again(stopped: Stopped) -> None:
    """Once for all processes of a job, and by one of them."""
    if not is_first():
        if SUBMITIT in os.environ:
            sys.exit(0)  # an error would end the first, which is at it
        return
    if SUBMITIT in os.environ:
        handler = signal.getsignal(getattr(signal, f"SIG{os.environ.get('SUBMITIT_PREEMPT_SIGNAL', 'USR2')}"))
        if callable(handler):
            handler(stopped.signum, None)
        return
    if job := _slurm_job():
        done = _scontrol("requeue", job)
        log.warning("job %s %s", job, "is queued again" if done is not None else "could not be queued again")


def _slurm_job() -> str | None:
    """Return the job's number, of an array with the task's; None outside of Slurm's batch jobs."""
    array, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")


def _is_preempted() -> bool:
    """Return true if Slurm ended this job for another one: SIGTERM alone may as well be scancel's."""
    job = _slurm_job()
    found = re.search(r"\bPreemptTime=(\S+)", _scontrol("show", "job", job) or "") if job else None
    return found is not None and found[1] not in ("None", "Unknown", "N/A")


def _scontrol(*words: str) -> str | None:
    """Return what Slurm's command says; None where it fails."""
    try:
        return subprocess.run(["scontrol", *words], capture_output=True, text=True, timeout=60, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        log.warning("scontrol %s: %s", " ".join(words), getattr(error, "stderr", None) or error)
        return None


def leave(stopped: Stopped, command: str) -> None:
    """End the process: the first of several says what was saved and how to go on.

    The others, which stop with it, end with status 0: Lightning would answer another one by killing the first.
    """
    if not is_first():
        sys.exit(0)
    print(f"{stopped} To go on: {command}", file=sys.stderr, flush=True)
    sys.exit(stopped.status)


def ignore_signals(worker: int) -> None:
    """For a process that loads data: its parent ends it when no more data is wanted."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
