"""The demonstration: what the shipped model does, then a training of one's own, each the same as its own command."""

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
from nerfdiff.evaluation.distill import distill
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.inputs import ASSETS, PACKAGE
from nerfdiff.training.run import train
from nerfdiff.utils.errors import UserError
from procedural.generate import make_scenes


def demo(cfg: DictConfig) -> None:
    """Distil unseen cars and a picture with the shipped model, then train a small model from scratch, and print tables
    and the pictures to open.

    Whatever an earlier, interrupted demonstration finished is kept.

    Raises:
        UserError: a step failed; its own message is above.
    """
    console, started, run = Console(), time.perf_counter(), Path(cfg.run)

    def announce(command: str, overrides: list[str]) -> list[str]:
        console.print(
            Rule(escape(" ".join(command_words(command)))),
            f"[dim]{escape(shlex.join(overrides))}[/dim]",
            soft_wrap=True,
        )
        return overrides

    def prepare(command: str, overrides: list[str]) -> DictConfig:
        return load_config(command, announce(command, overrides))

    def show(*pictures: Path) -> None:
        found = [f"  {path}" for path in pictures if path.exists()]
        console.print(
            f"{(time.perf_counter() - started) / 60:.1f} minutes. Open:", *found, sep="\n", markup=False, soft_wrap=True
        )

    root, distilled = f"root={cfg.root}", run / "distillation"
    make_scenes(prepare("make_scenes", [*cfg.make_scenes, *cfg.test_scenes, root]))
    # a sweep is Hydra's to run: a process of its own
    overrides = announce("distill", [*cfg.distill, f"data.root={cfg.root}", f"hydra.sweep.dir={distilled}"])
    paths = [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", "nerfdiff.commands.distill", *overrides]
    if subprocess.run(command, env=environment).returncode != 0:
        raise UserError("the distillation failed; see above")
    picture = run / "picture"
    image = ASSETS / "pictures" / "wagon.png"
    distill(prepare("distill", [*cfg.picture, f"image={image}", f"paths.output_dir={picture}"]))
    show(*(distilled / name for name in ("grid.png", "orbits.mp4", "table.md")), *sorted(picture.rglob("orbit.mp4")))

    make_scenes(prepare("make_scenes", [*cfg.make_scenes, *cfg.train_scenes, root]))
    trained = run / "training"
    train(
        prepare(
            "train", [*cfg.train, f"data.root={cfg.root}", f"paths.run_dir={trained}", f"paths.output_dir={trained}"]
        )
    )
    scored = [f"ckpt={trained}", f"data.root={cfg.root}", f"paths.output_dir={trained / 'evaluation'}"]
    evaluate(prepare("evaluate", [*cfg.evaluate, *scored]))
    previews = sorted((trained / "previews").glob("*.png"))
    show(*previews[:1], *previews[-1:], *sorted((trained / "evaluation").glob("*/sheet.png")))
    console.print(f"Curves: tensorboard --logdir {run}")
