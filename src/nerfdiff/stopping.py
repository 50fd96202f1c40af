"""Signals that end a run: work is saved first, one line says so, and the exit status tells which signal it was."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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

    Signals that are ignored stay so, as SIGHUP is under nohup.
    """

    def handle(signum: int, frame: FrameType | None) -> None:
        act(signum)

    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop(signum: int) -> None:
    """Raise `Stopped`, here and now."""
    raise Stopped(signum)


def leave(stopped: Stopped, command: str) -> None:
    """End the process: the first of several says what was saved and how to go on.

    The others, which stop with it, end with status 0: Lightning would answer another one by killing the first.
    """
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        sys.exit(0)
    print(f"{stopped} To go on: {command}", file=sys.stderr, flush=True)
    sys.exit(stopped.status)


def ignore_signals(worker: int) -> None:
    """For a process that loads data: its parent ends it when no more data is wanted."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
