"""Processes that share a run, as Lightning launches them: when one dies the others end too, and a sentence says so."""

import os
import signal
import sys
import threading
import time
from subprocess import Popen

import torch
from lightning.fabric.plugins.environments import TorchElasticEnvironment
from lightning.fabric.strategies.launchers import subprocess_script

GRACE = 10.0
"""Seconds that a process has to notice another's death by itself and to end with words of its own."""
_PARENT = os.getppid()
_launched: list[Popen] = []


def watch() -> None:
    """Look after the processes that are to be launched, or in one of them after the one that launched it."""
    # Lightning's own kills the first process too, before it can say or save anything.
    subprocess_script._ChildProcessObserver = _Observer
    if is_launched():
        threading.Thread(target=_end_with_parent, daemon=True).start()


def is_launched() -> bool:
    """Return true if another process of the run launched this one, which then speaks for it: torchrun does not."""
    return int(os.environ.get("LOCAL_RANK", 0)) > 0 and not TorchElasticEnvironment.detect()


def end_launched(signum: int) -> None:
    """Pass a signal on to the launched processes, and wait a little for their end."""
    for process in _launched:
        process.send_signal(signum)
    until = time.monotonic() + GRACE
    while any(process.poll() is None for process in _launched) and time.monotonic() < until:
        time.sleep(0.05)


def lost_process(error: RuntimeError) -> str | None:
    """A sentence on the death of another process; None where the error came of something else."""
    network = isinstance(error, torch.distributed.DistError) or "gloo" in str(error).lower()
    if not network:
        return None
    if "EADDRINUSE" in str(error):
        port = os.environ.get("MASTER_PORT", "unknown")
        return f"The port at which the processes of this run meet is in use: set MASTER_PORT to another than {port}."
    time.sleep(0.2)  # it is heard of before the system knows how it ended
    if is_launched() and os.getppid() == _PARENT:
        sys.exit(1)  # the first process will say it
    return gone()


def gone() -> str:
    """A sentence on the process that is gone, as far as this one knows of it."""
    if is_launched() and os.getppid() != _PARENT:
        return "The first process of this run ended."
    for rank, process in enumerate(_launched, 1):
        if code := process.poll():
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
            return f"Process {rank} of {len(_launched) + 1} {how}."
    return "Another process of this run ended, or cannot be reached."


class _Observer(subprocess_script._ChildProcessObserver):
    """Watch child processes: gloo reports a lost one by itself, NCCL would wait for ever."""

    def __init__(self, main_pid: int, child_processes: list[Popen], sleep_period: int = 5):
        super().__init__(main_pid, child_processes, sleep_period)
        _launched[:] = child_processes

    def _run(self) -> bool:
        codes = [process.poll() for process in self._child_processes]
        if not any(codes):
            return all(code == 0 for code in codes)
        if torch.distributed.is_initialized() and torch.distributed.get_backend() != "gloo":
            time.sleep(GRACE)
            print(f"error: {gone()} The same command goes on from the last checkpoint.", file=sys.stderr)
            for process in self._child_processes:
                process.kill()
            os._exit(1)
        return True


def _end_with_parent() -> None:
    while os.getppid() == _PARENT:
        time.sleep(1)
    time.sleep(GRACE)
    print(f"error: {gone()} The same command goes on.", file=sys.stderr)
    os._exit(1)
