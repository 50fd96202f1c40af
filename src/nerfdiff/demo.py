"""The demonstration: scenes, training and evaluation in one go, each the same as its own command."""

import shlex
import time
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console
from rich.rule import Rule

from nerfdiff.cli import load_config
from nerfdiff.evaluation import evaluate
from nerfdiff.results.row import ResultRow
from nerfdiff.results.table import rich_table, write_markdown
from nerfdiff.scenes.generate import make_scenes
from nerfdiff.training import train


def demo(cfg: DictConfig) -> list[ResultRow]:
    """Render small scenes, train on them, evaluate, and print one table and the pictures to open.

    Whatever an earlier, interrupted demonstration finished is kept.

    Returns:
        the rows of the table.
    """
    console, started, run = Console(), time.perf_counter(), Path(cfg.run)

    def prepare(command: str, overrides: list[str]) -> DictConfig:
        console.print(Rule(f"python src/{command}.py"), f"[dim]{shlex.join(overrides)}[/dim]", soft_wrap=True)
        return load_config(command, overrides)

    make_scenes(prepare("make_scenes", [*cfg.make_scenes, f"root={cfg.root}"]))
    train(prepare("train", [*cfg.train, f"data.root={cfg.root}", f"paths.run_dir={run}", f"paths.output_dir={run}"]))
    rows: list[ResultRow] = []
    for index, strategy in enumerate(cfg.strategies):
        overrides = [*cfg.evaluate, f"strategy={strategy}", f"ckpt={run}", f"data.root={cfg.root}"]
        overrides += [f"paths.output_dir={run / 'evaluation'}", f"baselines={str(index == 0).lower()}"]
        rows += evaluate(prepare("evaluate", overrides))

    console.print(Rule("held-out views of unseen cars"), rich_table(rows, console.width))
    write_markdown(run / "table.md", rows)
    pictures = sorted((run / "evaluation").glob("*/*.png")) + sorted((run / "evaluation").glob("*/*.mp4"))
    console.print("Open:", *(f"  {path}" for path in pictures), f"  {run / 'previews'}", sep="\n")
    console.print(f"{(time.perf_counter() - started) / 60:.1f} minutes")
    return rows
