"""All six benchmarks in turn, within a given time: what to run on a machine that is lent for minutes.

    python benchmarks/all.py --minutes 10
    python benchmarks/all.py --minutes 25 --model base --compile --sweeps

Tables are printed, files left in --out. A benchmark measures nothing new after most of its share of the time, and
says what it left out; one that still takes longer is stopped, and those after it run. What such benchmarks had measured
is in a file ….partial.json. Objects are computed from a few diffusion steps, and their rows say so, unless
--whole-objects is given.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import torch

from harness import RESULTS
from nerfdiff.cli import choices
from nerfdiff.evaluation.run import choose_device

SHARES = {"render": 1.0, "inner_step": 1.0, "unet": 2.0, "training_step": 3.0, "ngd_object": 3.0, "field_speed": 2.0}
SWEEPS = {
    "render": ("rays", "samples", "plane", "scenes"),
    "inner_step": ("rays", "views", "scenes"),
    "unet": ("views",),
    "training_step": ("batch",),
    "ngd_object": ("scenes",),
}
COMPILED = ("unet", "training_step", "ngd_object")
MEASURING = 0.75
"""Share of a benchmark's time that it measures: the rest is for what runs when that is over."""
CPU_RAYS = 512
"""Rays timed of a view, where a CPU renders it by pixel-aligned NeRFs."""


def main(words: list[str] | None = None) -> int:
    arguments = _arguments(words)
    jobs = plan(arguments)
    end = time.time() + 60 * arguments.minutes
    failed = []
    for number, (name, share, options) in enumerate(jobs):
        left = max(1.0, end - time.time())
        # what others did not use is shared by those to come
        own = left * share / sum(later for _, later, _ in jobs[number:])
        print(f"\n=== {name} {' '.join(options)} (at most {own:.0f} s)", flush=True)
        try:
            script = str(Path(__file__).with_name(f"{name}.py"))
            until = ["--until", f"{time.time() + MEASURING * own:.0f}"]
            done = subprocess.run([sys.executable, script, *options, *until], timeout=own)
            problem = f"exit status {done.returncode}" if done.returncode else None
        except subprocess.TimeoutExpired:
            problem = f"stopped after {own:.0f} s"
        if problem:
            failed.append(f"{name} {' '.join(options)}: {problem}")
    for line in failed:
        print(f"FAILED: {line}", file=sys.stderr)
    return len(failed)


def plan(arguments: argparse.Namespace) -> list[tuple[str, float, list[str]]]:
    """(benchmark, share of the time, its options)."""
    anyones = ["--device", arguments.device, "--out", str(arguments.out), "--seconds", str(arguments.seconds)]
    anyones += ["--size", str(arguments.size)] if arguments.size else []
    shared = anyones + (["--ckpt", arguments.ckpt] if arguments.ckpt else ["--model", arguments.model])
    papers = ("base", "large")
    fields = ["--models", *(papers if arguments.model in papers else (arguments.model,))]
    if choose_device(arguments.device).type == "cpu":
        fields += ["--rays", str(CPU_RAYS)]
    if arguments.model in papers and not arguments.ckpt:
        objects = ["--budget", "paper"] + ([] if arguments.whole_objects else ["--steps", "4", "--extrapolate"])
    else:
        objects = ["--budget", "minutes"]
    own = {"ngd_object": objects}
    jobs = []
    for name, share in SHARES.items():
        options = shared + own.get(name, []) + (["--compile"] if arguments.compile and name in COMPILED else [])
        jobs.append((name, share, options if name != "field_speed" else anyones + fields))
    if arguments.sweeps:
        for name, sweeps in SWEEPS.items():
            whole = ["--whole"] if name == "ngd_object" else []
            options = shared + own.get(name, []) + whole
            jobs += [(name, SHARES[name], [*options, "--sweep", sweep]) for sweep in sweeps]
    return jobs


def _arguments(words):
    cuda = torch.cuda.is_available()
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--minutes", type=float, default=10.0, help="for all together, at most")
    made.add_argument("--seconds", type=float, default=3.0, help="for each variant at each setting, about")
    made.add_argument("--model", choices=choices("model"), default="base" if cuda else "tiny", help="random weights")
    made.add_argument("--ckpt", help="a trained model instead")
    made.add_argument("--size", type=int, help="image side in pixels; default: the model's own")
    made.add_argument("--device", default="auto")
    made.add_argument("--out", type=Path, default=RESULTS)
    made.add_argument("--compile", action="store_true", help="also compiled U-Nets, whose first call takes minutes")
    made.add_argument("--sweeps", action="store_true", help="also the scaling curves, in the same time")
    made.add_argument("--whole-objects", action="store_true", help="time all diffusion steps of an object")
    return made.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
