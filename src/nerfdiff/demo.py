"""The demonstration: scenes, training, evaluation and distillation in one go, each the same as its own command."""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console
from rich.markup import escape
from rich.rule import Rule

from nerfdiff.cli import command_words, load_config
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.inputs import PACKAGE
from nerfdiff.training.run import train
from nerfdiff.utils.errors import UserError
from procedural.generate import make_scenes


def demo(cfg: DictConfig) -> None:
    """Render small scenes, train on them, evaluate, distil, and print tables and the pictures to open.

    Whatever an earlier, interrupted demonstration finished is kept.

    Raises:
        UserError: a step failed; its own message is above.
    """
    console, started, run = Console(), time.perf_counter(), Path(cfg.run)

    def announce(command: str, overrides: list[str]) -> list[str]:
        command_line = Rule(escape(" ".join(command_words(command))))
        console.print(command_line, f"[dim]{escape(shlex.join(overrides))}[/dim]", soft_wrap=True)
        return overrides

    def prepare(command: str, overrides: list[str]) -> DictConfig:
        return load_config(command, announce(command, overrides))

    make_scenes(prepare("make_scenes", [*cfg.make_scenes, f"root={cfg.root}"]))
    train(prepare("train", [*cfg.train, f"data.root={cfg.root}", f"paths.run_dir={run}", f"paths.output_dir={run}"]))
    trained = [f"ckpt={run}", f"data.root={cfg.root}"]
    evaluate(prepare("evaluate", [*cfg.evaluate, *trained, f"paths.output_dir={run / 'evaluation'}"]))
    # a sweep is Hydra's to run: a process of its own
    overrides = announce("distill", [*cfg.distill, *trained, f"hydra.sweep.dir={run / 'distillation'}"])
    paths = [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", "nerfdiff.commands.distill", *overrides]
    if subprocess.run(command, env=environment).returncode != 0:
        raise UserError("the distillation failed; see above")

    pictures = [run / "distillation" / name for name in ("grid.png", "orbits.mp4", "table.md")]
    pictures += sorted((run / "evaluation").glob("*/sheet.png"))
    console.print(
        "Open:", *(f"  {path}" for path in pictures if path.exists()), f"  {run / 'previews'}", sep="\n", markup=False
    )
    console.print(f"{(time.perf_counter() - started) / 60:.1f} minutes")
