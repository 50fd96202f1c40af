"""Functions that run in a forked copy of this process, which knows all imports already, to be killed at leisure."""

import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nerfdiff.cli import explain
from nerfdiff.stopping import Stopped, on_signals, stop

TRACEBACK = 99


@dataclass
class Child:
    """A running copy; `wait` for its exit status, which is negative where a signal ended it."""

    pid: int
    said: Path

    def kill(self, signum: int = signal.SIGKILL) -> None:
        os.kill(self.pid, signum)

    def wait(self, timeout: float = 300) -> int:
        until = time.monotonic() + timeout
        while time.monotonic() < until:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.01)
        self.kill()
        os.waitpid(self.pid, 0)
        raise TimeoutError(f"still running after {timeout} s: {self.words()}")

    def words(self) -> str:
        """What it said of its end."""
        return self.said.read_text() if self.said.is_file() else ""


def start(folder: Path, function: Callable[[], object], memory: int | None = None) -> Child:
    """Run a function in a child that ends as a command would: 0; 1 with a sentence; 128 + a signal's number; or
    `TRACEBACK`.

    Args:
        folder: where its last words go.
        memory: bytes of address space that it may take beside this process's.
    """
    said = folder / f"said{time.monotonic_ns()}.txt"
    pid = os.fork()
    if pid:
        return Child(pid, said)
    status = TRACEBACK
    try:
        if memory is not None:
            taken = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
            resource.setrlimit(resource.RLIMIT_AS, (taken + memory, resource.RLIM_INFINITY))
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        with on_signals(stop):
            function()
        status = 0
    except Stopped as stopped:
        status = stopped.status
    except BaseException as error:
        sentence = explain(error)
        status = TRACEBACK if sentence is None else 1
        said.write_text("".join(traceback.format_exception(error)) if sentence is None else sentence)
    finally:
        sys.stdout.flush()
        os._exit(status)
