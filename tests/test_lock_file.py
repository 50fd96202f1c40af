"""The lock file has what pyproject.toml asks for, with hashes."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

PROJECT = Path(__file__).parents[1]
LOCKED = ("scenes", "chart", "mesh", "view", "fid", "joblib", "submitit", "optuna", "all", "docs", "dev")
"""Extras that are part of dev, or dev."""
ENTRY = r"[\w.-]+==[\w.]+( ; [^\\\n]+)?( \\\n    --hash=sha256:[0-9a-f]{64})+"


def locked() -> dict[str, list[str]]:
    """Entries by package: one, or one for each kind of machine that its marker tells."""
    found: dict[str, list[str]] = {}
    for entry in re.split(r"\n(?=\S)", (PROJECT / "requirements.lock").read_text().strip()):
        found.setdefault(canonicalize_name(entry.partition("==")[0]), []).append(entry)
    return found


def test_every_requirement_is_locked_at_a_version_that_suits():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    groups = project["optional-dependencies"]
    assert set(groups) - {"cutout", "streaming"} == set(LOCKED)  # which bring much of their own, and are no part of dev
    asked = [*project["dependencies"], *(one for group in LOCKED for one in groups[group])]
    entries, checked = locked(), 0
    for requirement in map(Requirement, asked):
        if requirement.name == project["name"]:
            assert requirement.extras <= set(project["optional-dependencies"])
            continue
        name = canonicalize_name(requirement.name)
        assert name in entries, f"{requirement}: run make lock"
        for entry in entries[name]:
            version = Version(re.match(r"\S+?==(\S+)", entry)[1])
            assert version in requirement.specifier, f"{requirement}: run make lock"
            checked += 1
    assert checked >= len(asked) - 3


def test_every_entry_is_of_one_version_with_hashes():
    for entries in locked().values():
        for entry in entries:
            assert re.fullmatch(ENTRY, entry), entry[:80]
