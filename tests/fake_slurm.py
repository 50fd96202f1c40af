"""A Slurm of one machine: `sbatch`, `srun`, `sacct`, `scontrol` and `scancel` on the PATH, and what runs the jobs.

Submitit's jobs run in forked copies of one process, which knows all imports already; other scripts are run by bash.
(Nothing of ours calls `squeue`.)

Policy, by an array's task of the first submission: `killed` dies at once, `killed_late` when all is done but for
telling it, `timeout` is ended by Slurm, `preempted` gets the signals and is to ask for the queue again. A second try is
left in peace.
"""

import gc
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

SRC = Path(__file__).parents[1] / "src"
COMMANDS = ("sbatch", "srun", "sacct", "scontrol", "scancel")
FINAL = ("COMPLETED", "FAILED", "TIMEOUT", "CANCELLED", "NODE_FAIL")
SLOW = "FAKE_SLURM_SLOW"
"""In the environment of a job that is to work until something happens to it."""


@contextmanager
def slurm(folder: Path, policy: dict[str, list[int]], imports: Sequence[str] = (), parallel: int = 4):
    """The environment in which commands find it."""
    (folder / "bin").mkdir(parents=True)
    for name in ("jobs", "asked"):
        (folder / name).mkdir()
    (folder / "policy.json").write_text(json.dumps(policy))
    for name in COMMANDS:
        command = folder / "bin" / name
        command.write_text(f'#!/bin/sh\nexec {sys.executable} -S {__file__} {name} {folder} "$@"\n')
        command.chmod(0o755)
    environment = os.environ | {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(SRC)}
    words = [sys.executable, __file__, "control", str(folder), str(parallel), *imports]
    with open(folder / "control.log", "w") as log:
        control = subprocess.Popen(words, env=environment, stdout=log, stderr=log)
    try:
        yield environment
    finally:
        control.terminate()
        control.wait()


def jobs(folder: Path) -> dict[str, dict]:
    """Every job by its number."""
    return {path.stem: json.loads(path.read_text()) for path in sorted((folder / "jobs").glob("*.json"))}


def change(folder: Path, job: str, **values) -> dict:
    path = folder / "jobs" / f"{job}.json"
    content = (json.loads(path.read_text()) if path.exists() else {}) | values
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    temporary.write_text(json.dumps(content))
    temporary.replace(path)
    return content


def ask(folder: Path, what: str, job: str, number: int = 0) -> None:
    """Leave a note for `control`."""
    note = folder / "asked" / f"{time.monotonic_ns()}.tmp"
    note.write_text(json.dumps([what, job, number]))
    note.rename(note.with_suffix(".json"))


def sbatch(folder: Path, script: str) -> None:
    text = Path(script).read_text()
    number = str(100 + len(list((folder / "jobs").glob("*.sh"))))
    found = re.search(r"^#SBATCH --array=(\d+)-(\d+)", text, re.M)
    tasks = range(int(found[1]), int(found[2]) + 1) if found else [None]
    for task in tasks:
        change(folder, number if task is None else f"{number}_{task}", state="PENDING", tries=0)
    (folder / "jobs" / f"{number}.sh").write_text(text)  # last: the jobs begin
    print(f"Submitted batch job {number}")


def sacct(folder: Path, *arguments: str) -> None:
    wanted = [value for option, value in pairwise(arguments) if option == "-j"]
    print("JobID|State|NodeList")
    for number, job in jobs(folder).items():
        if number.split("_")[0] in wanted:
            print(f"{number}|{job['state']}|here")


def scontrol(folder: Path, verb: str, *arguments: str) -> None:
    with open(folder / "scontrol.log", "a") as log:
        log.write(f"{verb} {' '.join(arguments)}\n")
    if verb == "requeue":
        ask(folder, "requeue", arguments[0])
    elif arguments[:1] == ("job",):
        print(f"JobId={arguments[1]} PreemptTime=None")


def send(folder: Path, job: str, signum: int) -> None:
    """Send a running job's steps a signal, as `--signal` does."""
    ask(folder, "signal", job, signum)


def scancel(folder: Path, number: str) -> None:
    ask(folder, "cancel", number)


def srun(folder: Path, *arguments: str) -> None:
    words = list(arguments)
    while words[0].startswith("-"):
        option = words.pop(0)
        if option in ("--output", "--error"):
            words.pop(0)
    os.execvp(words[0], words)


def control(folder: Path, parallel: int) -> None:
    """Start what waits, and write down what became of it."""
    running: dict[int, str] = {}
    waiting: list[str] = []
    tries: dict[str, int] = {}
    requeued, seen = set(), set()
    signal.signal(signal.SIGTERM, lambda *_: ([os.kill(pid, signal.SIGKILL) for pid in running], os._exit(0)))
    policy = json.loads((folder / "policy.json").read_text())
    gc.freeze()
    while True:
        for script in sorted(set((folder / "jobs").glob("*.sh")) - seen):
            seen.add(script)
            found = [p.stem for p in (folder / "jobs").glob(f"{script.stem}*.json")]
            waiting += sorted(found, key=lambda name: int(name.partition("_")[2] or 0))
        for note in sorted((folder / "asked").glob("*.json")):
            what, name, number = json.loads(note.read_text())
            note.unlink()
            mine = [pid for pid, of in running.items() if name in (of, of.partition("_")[0])]
            if what == "requeue":
                requeued.add(name)
            elif what == "signal":  # to the job's steps: what the script's shell runs
                below = [Path(f"/proc/{pid}/task/{pid}/children").read_text().split() for pid in mine]
                [os.kill(int(child), number) for children in below for child in children]
            else:
                [os.kill(pid, signal.SIGKILL) for pid in mine]
                gone = [of for of in waiting if name in (of, of.partition("_")[0])]
                waiting = [of for of in waiting if of not in gone]
                [change(folder, of, state="CANCELLED") for of in gone]
        for pid in list(running):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                name, code = running.pop(pid), os.waitstatus_to_exitcode(status)
                state = "COMPLETED" if code == 0 else "TIMEOUT" if code == -signal.SIGXCPU else "FAILED"
                if name in requeued:
                    requeued.remove(name)
                    waiting.append(name)
                    state = "PENDING"
                change(folder, name, state=state, code=code)
        while waiting and len(running) < parallel:
            name = waiting.pop(0)
            tries[name] = tries.get(name, 0) + 1
            change(folder, name, state="RUNNING", tries=tries[name])
            running[start(folder, name, fate(policy, name, tries[name]))] = name
        time.sleep(0.02)


def fate(policy: dict[str, list[int]], name: str, tries: int) -> str | None:
    number, _, task = name.partition("_")
    if number != "100" or tries > 1:
        return None
    return next((kind for kind, tasks in policy.items() if int(task or 0) in tasks), None)


def start(folder: Path, name: str, what: str | None) -> int:
    if pid := os.fork():
        return pid
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    number, _, task = name.partition("_")
    script = folder / "jobs" / f"{number}.sh"
    environment = {"SLURM_JOB_ID": number, "SLURM_JOB_NAME": "job", "SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1"}
    environment |= dict.fromkeys(("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NODEID"), "0")
    if task:
        array = {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": task}
        environment |= array | {"SLURM_JOB_ID": f"{number}{int(task):04d}"}
    os.environ.update(environment)
    log = os.open(folder / "jobs" / f"{name}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    code = 1
    try:
        act(what)
        found = re.search(r"python\S* -u -m submitit\.core\._submit (\S+)", script.read_text())
        if found:
            os.environ["SUBMITIT_EXECUTOR"] = "slurm"
            sys.argv = ["_submit", found[1]]
            runpy.run_module("submitit.core._submit", run_name="__main__")
            code = 0
        else:
            os.execvp("bash", ["bash", str(script)])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException as error:
        print(repr(error), file=sys.stderr)
    finally:
        sys.stdout.flush()
        os._exit(code & 255)


def act(what: str | None) -> None:
    """What happens to this job."""
    if what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif what == "killed_late":
        import submitit.core.utils as utils

        utils.cloudpickle_dump = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    elif what in ("timeout", "preempted"):
        os.environ[SLOW] = "1"
        numbers = [signal.SIGXCPU] if what == "timeout" else [signal.SIGCONT, signal.SIGTERM, signal.SIGUSR2]

        def later() -> None:
            while not callable(signal.getsignal(signal.SIGUSR2)):  # submitit is not there yet
                time.sleep(0.02)
            time.sleep(0.3)
            for number in numbers:
                signal.pthread_kill(threading.main_thread().ident, number)  # as from outside: it ends a sleep

        threading.Thread(target=later, daemon=True).start()


if __name__ == "__main__":
    verb, place, *rest = sys.argv[1:]
    if verb == "control":
        for module in rest[1:]:
            __import__(module)
        control(Path(place), int(rest[0]))
    else:
        globals()[verb](Path(place), *rest)
