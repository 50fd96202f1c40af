"""Command-line values as people type them, quoted where Hydra's grammar would misread them."""

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from os.path import isfile

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

PATHS = re.compile(r"ckpt|init|kept_renderings|image|mask|out|root|results|run|dir|\w+_dir|\w+_weights")
"""Last parts of the keys that take paths."""

LISTS: dict[str, dict[str, str]] = {
    "export": {"field": "fields", "fields": "fields", "format": "format"},
    "view": {"field": "fields", "fields": "fields"},
    "picture": {"image": "images", "images": "images", "format": "format"},
}
"""By commands: words that take a list, and their keys, which differ where a group of configs has the word."""

NUMBERS: dict[str, tuple[str, ...]] = {"picture": ("box",)}
"""By commands: keys that take several numbers, which are no sweep."""

BARE: dict[str, str] = {"picture": "images"}
"""By commands: the key that words without a key are values of."""


def quote_values(words: Sequence[str]) -> list[str]:
    """Overrides in which a value that Hydra cannot read is quoted for it; options and other words as they are.

    `~` is expanded. A value for a key that takes paths is quoted as well where a file of that very name is there
    (`a,b.png` is no sweep then), and where Hydra would make a number of it. Choices of a sweep and elements of a list
    are quoted one by one. What is quoted already is kept.
    """
    return [_quote_word(word) for word in words]


def gather_lists(command: str, words: Sequence[str]) -> list[str]:
    """Write the values of `LISTS`, `NUMBERS` and `BARE` as Hydra's lists: `format=glb,ply` is no sweep there."""
    lists, bare = LISTS.get(command, {}), BARE.get(command)
    found: dict[str, list[str]] = {}
    others = []
    for before, word in pairwise(["", *words]):
        key, equals, value = word.partition("=")
        if bare and not word.startswith(("-", "~")) and not before.startswith("-") and (not equals or isfile(word)):
            found.setdefault(bare, []).append(word)
        elif key in NUMBERS.get(command, ()) and "," in value and value[:1] not in ("[", "'", '"'):
            others.append(f"{key}=[{value}]")
        elif key not in lists or not equals:
            others.append(word)
        elif not (whole := os.path.exists(os.path.expanduser(value))) and value[:1] in ("[", "'", '"'):
            others.append(f"{lists[key]}={value}")
        else:
            found.setdefault(lists[key], []).extend([value] if whole else filter(None, _split(value)))
    expanded = {key: [_literal(os.path.expanduser(value)) for value in values] for key, values in found.items()}
    return [*(f"{key}=[{','.join(values)}]" for key, values in expanded.items()), *others]


def parse_override(word: str) -> Override | None:
    """Hydra's reading of a word; None where it has none."""
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None


def _quote_word(word: str) -> str:
    key, equals, value = (part.strip() for part in word.partition("="))
    if not equals or not value or word.startswith(("-", "~")):
        return word
    return f"{key}={_quote(value, is_path=bool(PATHS.fullmatch(key.lstrip('+').rpartition('.')[2])))}"


def _quote(value: str, is_path: bool) -> str:
    home = os.path.expanduser(value)
    override = parse_override(f"key={home}")
    quoted = value[:1] in ("'", '"')
    plain = override is not None and (override.value() == home or quoted)
    if not plain and (is_path or override is None) and os.path.exists(home):
        return _literal(home)
    if override is not None and not is_path:
        return home
    if len(parts := _split(value)) > 1:
        return ",".join(_quote(part, is_path) for part in parts)
    if value[:1] == "[" and value[-1:] == "]":
        return f"[{','.join(_quote(part, is_path) for part in _split(value[1:-1]))}]"
    if override is None:
        return _literal(home) if is_path or value[:1] not in ("[", "{", "'", '"') else value
    if isinstance(override.value(), bool | int | float):
        return _literal(value)
    if quoted and override.value().startswith("~"):
        return _literal(os.path.expanduser(override.value()))
    return home


def _split(value: str) -> list[str]:
    """The parts between the commas that are neither within brackets nor within a quoted part."""
    parts, start, depth, quote = [], 0, 0, ""
    for position, character in enumerate(value):
        if quote:
            quote = "" if character == quote and value[position - 1] != "\\" else quote
        elif character in "'\"" and not value[start:position].strip():
            quote = character
        elif character in "([{":
            depth += 1
        elif character in ")]}":
            depth = max(0, depth - 1)
        elif character == "," and depth == 0:
            parts.append(value[start:position])
            start = position + 1
    return [part.strip() for part in [*parts, value[start:]]]


def _literal(text: str) -> str:
    return QuotedString(text, Quote.single).with_quotes()
