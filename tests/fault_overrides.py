"""Commands with keys and values that are drawn at random; `fault_overrides.py <command> <data> <run> <folder>`.

Writes a line for each: the override, the exit status and what was said.
"""

import json
import random
import re
import sys
from pathlib import Path

from omegaconf import OmegaConf

from fault_child import start
from nerfdiff.cli import load_config
from nerfdiff.evaluation.distill import distill
from nerfdiff.evaluation.evaluate import evaluate
from training_fixtures import evaluation_overrides, run_training

VALUES = ("-1", "0", "1", "0.5", "nan", "-inf", "text", "[]", "{}", "true", "'${nothing}'", "[-1]", "1e-30")
TRIES = {"train": 60, "distill": 40, "evaluate": 40}


def leaves(config, prefix: str = "") -> list[str]:
    """Keys of all values; not of files and folders, nor of classes."""
    found = []
    for key, value in OmegaConf.to_container(config, resolve=False).items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            found += leaves(OmegaConf.create(value), f"{name}.")
        elif re.fullmatch(r"[\w.]+", name) and not re.search(
            r"_target_|dir|root|folder|path|^ckpt|^init|kept|results|image$|mask|^hydra", name
        ):
            found.append(name)
    return found


def act(name: str, data: Path, run: Path, out: Path, word: str):
    """The command with one more override."""
    if name == "train":
        return lambda: run_training(data, out, "trainer.max_steps=2", "callbacks.last.every_n_steps=2", word)
    small = "budget.steps=2", "budget.inner_steps=2", "budget.rays=32", "budget.views=2", "orbit.frames=2"
    words = "budget=minutes", *small, "metrics.st_lpips=false", "data.eval_scenes=1", word
    command = distill if name == "distill" else evaluate
    return lambda: command(load_config(name, evaluation_overrides(data, run, out, *words)))


def main(name: str, data: Path, run: Path, folder: Path) -> None:
    draw = random.Random(7)
    keys = leaves(load_config(name, [] if name == "train" else ["ckpt=demo"]))
    for number in range(TRIES[name]):
        word = f"{draw.choice(keys)}={draw.choice(VALUES)}"
        child = start(folder, act(name, data, run, folder / str(number), word), memory=4 * 2**30)
        try:
            status = child.wait(120)
        except TimeoutError:
            status = -1
        print(json.dumps([word, status, child.words()]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], *map(Path, sys.argv[2:]))
