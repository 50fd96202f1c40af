"""`--help` of every command: one screen, whose examples, groups and keys are there."""

import re
import sys
from pathlib import Path
from runpy import run_module

import pytest
from omegaconf import OmegaConf

from nerfdiff.cli import CONF, _composed, check_overrides, choices
from nerfdiff.inputs import NO_SCENE
from nerfdiff.quoting import gather_lists, quote_values
from test_documents import commands

COMMANDS = sorted(path.stem for path in (Path(__file__).parents[1] / "src").glob("*.py"))


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_one_screen_of_what_is_there(command, monkeypatch, capsys):
    monkeypatch.setattr("nerfdiff.cli.keep_freed_memory", lambda: None)
    monkeypatch.setattr(sys, "argv", [f"{command}.py", "--help"])
    with pytest.raises(SystemExit) as end:
        run_module(f"nerfdiff.commands.{command}", run_name="__main__")
    assert end.value.code == 0
    said, warned = capsys.readouterr()
    assert warned == "" and len(said.splitlines()) <= 50 and max(map(len, said.splitlines())) <= 120
    what, *rest = said.strip().split("\n\n")
    parts = dict(part.split("\n", 1) for part in rest[:-1])
    assert re.fullmatch(r"[A-Z].+\.", what) and rest[-1].startswith(f"All keys: python src/{command}.py --cfg job.")

    examples = list(commands(f"```\n{parts['Examples:']}\n```"))
    assert 2 <= len(examples) == len(parts["Examples:"].splitlines()) <= 5
    for path, words in examples:
        assert path == f"src/{command}.py"
        assert not any("=assets/" in word for word in words)  # which an installed command does not have
        if command in ("train", "distill", "evaluate"):
            assert any(word.startswith(("data.root=", "image=")) for word in words)  # or it ends with "no such folder"
        check_overrides(command, quote_values(gather_lists(command, words)))  # which composes

    config = _composed(command)
    keys = [re.match(r"  (\S+)  +\S", line)[1] for line in parts["Keys, which are set by key=value:"].splitlines()]
    assert len(keys) >= 3
    for key in keys:
        node, _, name = key.rpartition(".")
        assert name in list(OmegaConf.select(config, node) if node else config), key
    groups = parts.get("Groups, of which one is chosen by group=name:", "")
    for group, names in re.findall(r"^  (\w+)  +(.+(?:\n {5,}.+)*)", groups, re.M):
        assert (CONF / group).is_dir() and names.replace("\n", " ").replace(",", "").split() == [
            name for name in choices(group) if command != "picture" or name not in NO_SCENE
        ]
