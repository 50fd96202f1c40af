"""The configurations that a sweep may try: axes with their choices, of which not every strategy has all."""

import random
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import prod

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from nerfdiff.utils.errors import ConfigError

SEED = "seed"

Configuration = tuple[str, ...]
"""Overrides `key=value` of one point of the space, without the seed."""


@dataclass(frozen=True)
class Axis:
    """A key of the overrides, with its prefix, and an override `key=value` per choice; one choice is a fixed value."""

    key: str
    words: tuple[str, ...]

    @property
    def varies(self) -> bool:
        return len(self.words) > 1


@dataclass(frozen=True)
class Space:
    """Every configuration once.

    Args:
        branches: for each combination of config groups' choices, the axes that matter there.
        groups: keys of those that have several choices.
        seeds: the overrides with which every configuration is run; empty where the seed is not swept over.
    """

    branches: tuple[tuple[Axis, ...], ...]
    groups: tuple[str, ...] = ()
    seeds: tuple[str, ...] = ()

    def __len__(self) -> int:
        return sum(prod(len(axis.words) for axis in branch) for branch in self.branches)

    def __iter__(self) -> Iterator[Configuration]:
        for branch in self.branches:
            yield from product(*(axis.words for axis in branch))

    def draw(self, rng: random.Random) -> Configuration:
        """One configuration: all branches are as probable, and then all choices of each axis."""
        return tuple(rng.choice(axis.words) for axis in rng.choice(self.branches))

    def find(self, words: Iterable[str]) -> Configuration | None:
        """The configuration of a job with these overrides, in any order; None where it is none of this space."""
        words = set(words) - set(self.seeds)
        for branch in self.branches:
            found = tuple(word for axis in branch for word in axis.words if word in words)
            if len(found) == len(branch) == len(words):
                return found
        return None

    def branch_of(self, configuration: Configuration) -> int | None:
        """The number of the branch that a configuration is of; None where it is none of this space."""
        for number, branch in enumerate(self.branches):
            fits = [word in axis.words for axis, word in zip(branch, configuration, strict=False)]
            if len(branch) == len(configuration) and all(fits):
                return number
        return None

    def untried(self, tried: Iterable[Configuration]) -> "Space":
        """The branches of which not every configuration has been tried."""
        counts = Counter(map(self.branch_of, tried))
        sizes = [prod(len(axis.words) for axis in branch) for branch in self.branches]
        return replace(self, branches=tuple(b for n, b in enumerate(self.branches) if counts[n] < sizes[n]))

    @cached_property
    def varied(self) -> frozenset[str]:
        """The overrides that some configurations have and others have not."""
        sets = [{word for axis in branch for word in axis.words if not axis.varies} for branch in self.branches]
        everything = {word for branch in self.branches for axis in branch for word in axis.words}
        return frozenset(everything - set.intersection(*sets))

    def named(self, words: Iterable[str]) -> list[str]:
        """The choices of config groups among the overrides of a job."""
        pairs = [word.partition("=") for word in words]
        return [value for key, _, value in pairs if key in self.groups] or ["job"]


def parse(words: Sequence[str]) -> list[Override]:
    """Hydra's overrides of `key=value` words.

    Raises:
        ConfigError: a word that Hydra cannot read.
    """
    try:
        return OverridesParser.create().parse_overrides(list(words))
    except HydraException as error:
        raise ConfigError(f"cannot read the overrides {' '.join(words)}: {str(error).splitlines()[0]}") from error


def axes_of(words: Sequence[str]) -> list[Axis]:
    """An axis per key of Hydra's sweep syntax (`a=1,2`, `a=range(3)`); the last word of a key counts.

    Raises:
        ConfigError: a sweep whose values cannot be enumerated.
    """
    axes: dict[str, Axis] = {}
    for override in parse(words):
        key = override.get_key_element()
        if override.is_discrete_sweep():
            values = list(dict.fromkeys(override.sweep_string_iterator()))
        elif override.is_sweep_override():
            raise ConfigError(f"{override.input_line}: this sweeper takes lists of values, choice(…) and range(…)")
        elif override.value_type is None:  # ~key
            axes[key] = Axis(key, (key,))
            continue
        else:
            values = [override.get_value_element_as_str()]
        axes[key] = Axis(key, tuple(f"{key}={value}" for value in values))
    return list(axes.values())


def space_of(
    params: Sequence[str],
    params_for: Mapping[str, Mapping[str, Mapping[str, str]]],
    arguments: Sequence[str],
    compose: Callable[[list[str]], DictConfig],
    is_group: Callable[[str], bool],
    indirect: Sequence[str],
) -> Space:
    """The space of a sweep. Where the key of an axis does not exist or changes nothing, the axis is left out.

    Args:
        params: words of Hydra's sweep syntax.
        params_for: further ones, `key: choices`, that hold where a config group has a choice.
        arguments: further ones, each in place of those of its key.
        compose: overrides to a config with Hydra's node.
        is_group: whether a key is a config group.
        indirect: nodes of the config that nothing reads but interpolations in others: what is set there matters where
            an interpolation picks it up.

    Raises:
        ConfigError: words that cannot be read, or a value for a key that no configuration has.
    """
    everywhere = axes_of([*params, *arguments])
    groups = [axis for axis in everywhere if is_group(axis.key.lstrip("+~"))]
    branches, known = [], {SEED}
    for choices in product(*(axis.words for axis in groups)):
        config = compose(list(choices))
        known |= {axis.key for axis in everywhere if axis in groups or _exists(config, axis.words[0])}
        taken = config.hydra.runtime.choices
        here = [by_choice.get(taken.get(group), {}) for group, by_choice in params_for.items()]
        words = [f"{key}={values}" for chosen in here for key, values in chosen.items()]
        branches.append(_branch(axes_of([*params, *words, *arguments]), choices, config, indirect))
    for axis in everywhere:
        if not axis.varies and axis.key not in known:
            raise ConfigError(f"{axis.words[0]}: none of the sweep's configurations has this key")
    seeds = next((axis.words for axis in everywhere if axis.key == SEED), ())
    return Space(tuple(branches), tuple(axis.key for axis in groups if axis.varies), seeds)


def _branch(
    axes: Sequence[Axis], choices: Sequence[str], config: DictConfig, indirect: Sequence[str]
) -> tuple[Axis, ...]:
    """The axes that matter in a config composed of the choices of all groups, with the words that exist there."""
    used = _used(OmegaConf.to_container(config), [*indirect, "hydra"])
    own = []
    for axis in axes:
        if chosen := set(axis.words) & set(choices):
            own.append(replace(axis, words=tuple(chosen)))
        elif axis.key != SEED and _matters(axis.key, used, indirect):
            own.append(replace(axis, words=tuple(word for word in axis.words if _exists(config, word))))
    return tuple(axis for axis in own if axis.words)


def _matters(key: str, used: set[str], indirect: Sequence[str]) -> bool:
    """Return true if something reads the key; one in an indirect node, through an interpolation to, around or in it."""
    if key.partition(".")[0] not in indirect:
        return True
    return any(f"{key}.".startswith(f"{other}.") or other.startswith(f"{key}.") for other in used)


def _exists(config: DictConfig, word: str) -> bool:
    """Return true if a config has the key of an override, and those of a mapping that is to be merged into it."""
    (override,) = parse([word])
    if override.is_add() or override.is_force_add() or override.is_delete():
        return True
    return _has(config, override.key_or_group, override.value())


def _has(config: DictConfig, key: str, value: object) -> bool:
    parent, _, last = key.rpartition(".")
    node = OmegaConf.select(config, parent) if parent else config
    if not isinstance(node, DictConfig) or last not in list(node):  # `in` overlooks mandatory values
        return False
    return not isinstance(value, dict) or all(_has(config, f"{key}.{name}", inner) for name, inner in value.items())


def _used(config: dict, without: Sequence[str]) -> set[str]:
    """Collect the keys that interpolations outside of some nodes refer to, and what those refer to in turn.

    Args:
        config: with its interpolations as text.
    """
    found: set[str] = set()
    new = _references([value for key, value in config.items() if key not in without])
    while new:
        found |= new
        new = _references([_at(config, reference) for reference in new]) - found
    return found


def _references(node: object) -> set[str]:
    if isinstance(node, dict | list):
        return set().union(*map(_references, node.values() if isinstance(node, dict) else node))
    return set(re.findall(r"\$\{([A-Za-z_][\w.]*)\}", node)) if isinstance(node, str) else set()


def _at(node: object, path: str) -> object:
    for part in path.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return node
