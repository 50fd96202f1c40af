"""The Dockerfile, which no Docker has built here: what it copies is there, and what it makes are targets."""

import json
import re
import shlex
from pathlib import Path

PROJECT = Path(__file__).parents[1]
LINES = re.sub(r"\\\n\s*", " ", (PROJECT / "Dockerfile").read_text()).splitlines()
INSTRUCTIONS = [line.split(" ", 1) for line in LINES if line and not line.startswith("#")]
MAKEFILE = (PROJECT / "Makefile").read_text()


def of(name: str) -> list[str]:
    return [rest for word, rest in INSTRUCTIONS if word == name]


def test_instructions_are_ones_that_docker_knows():
    known = {"FROM", "ARG", "RUN", "WORKDIR", "COPY", "ENV", "EXPOSE", "CMD"}
    assert {word for word, _ in INSTRUCTIONS} <= known and INSTRUCTIONS[0][0] == "FROM"
    assert len(of("CMD")) == 1


def test_what_it_copies_is_there_and_sent_to_the_builder():
    ignored = (PROJECT / ".dockerignore").read_text().splitlines()
    assert "*" in ignored
    sent = {line.removeprefix("!") for line in ignored if line.startswith("!")}
    copied = [path for rest in of("COPY") for path in shlex.split(rest)[:-1]]
    for path in copied:
        assert (PROJECT / path).exists() and path.split("/")[0] in sent, path
    assert {path.split("/")[0] for path in copied} == sent  # and nothing for nothing


def test_what_setup_reads_is_copied_before_it():
    before = INSTRUCTIONS[: next(i for i, (_, rest) in enumerate(INSTRUCTIONS) if "make setup" in rest)]
    copied = [path for word, rest in before if word == "COPY" for path in shlex.split(rest)[:-1]]
    version = (PROJECT / "pyproject.toml").read_text().split('version = {attr = "')[1].split(".__")[0]
    assert {"pyproject.toml", "setup.py", "requirements.lock", "Makefile", f"src/{version}/__init__.py"} <= set(copied)


def test_what_it_makes_are_targets_and_variables_of_the_makefile():
    targets = re.search(r"^\.PHONY: (.+)$", MAKEFILE, re.M)[1].split()
    said = [run for run in of("RUN") if run.startswith("make ")]
    made = [*(shlex.split(words)[1:] for words in said), json.loads(of("CMD")[0])[1:]]
    assert [words[0] for words in made] == ["setup", "demo"]
    for target, *settings in made:
        assert target in targets
        for setting in settings:
            assert re.search(rf"^{setting.partition('=')[0]} \?=", MAKEFILE, re.M), setting
    assert of("ARG") == ["TORCH=cpu"] and "TORCH=${TORCH}" in said[0]


def test_commands_in_its_words_are_there():
    comments = "\n".join(line for line in LINES if line.startswith("#"))
    assert all((PROJECT / path).is_file() for path in re.findall(r"python (src/\w+\.py)", comments))
    assert re.findall(r"--build-arg (\w+)=", comments) == ["TORCH"]
