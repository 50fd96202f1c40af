"""What the entry points share: overrides checked before anything runs, and errors a person can read."""

import difflib
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import CompactHydraException, HydraException, InstantiationException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nerfdiff.cpu_memory import keep_freed_memory
from nerfdiff.errors import ConfigError, UserError

CONF = Path(__file__).parents[2] / "conf"

# What a value must be, by the type of its default.
KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("bool", (bool,)),
    int: ("int", (int,)),
    float: ("int or float", (int, float)),
    list: ("a list", (list,)),
    DictConfig: ("a mapping", (dict,)),
}
# Keys that take values of two kinds.
EITHER: dict[str, tuple[type, ...]] = {
    "image_size": (int, list),  # one side of a square, or [height, width]
    "crop": (int, list),
    "checkpointing": (bool, list, str),  # everywhere or nowhere, at some resolutions, or auto
}
OPTIONAL_GROUPS = ("logger", "experiment", "sweep")


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], object]], Callable[[], None]]:
    """Make a function of a config into a command.

    Overrides are checked against the composed defaults: an unknown key or a value of the wrong kind ends the
    command with the keys that exist. What `explain` knows ends it with one line and exit status 1;
    HYDRA_FULL_ERROR=1 gives the traceback instead.
    """

    def decorate(function: Callable[[DictConfig], object]) -> Callable[[], None]:
        @functools.wraps(function)
        def run(cfg: DictConfig) -> object:
            try:
                return function(cfg)
            except Exception as error:
                message = explain(error)
                if message is None or os.environ.get("HYDRA_FULL_ERROR") == "1":
                    raise
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    # an exit would end the jobs still to come; this Hydra keeps for the end, and prints as one line
                    raise CompactHydraException(f"error: {message}") from error
                sys.exit(f"error: {message}")

        command = hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)(run)

        @functools.wraps(function)
        def main() -> None:
            try:
                check_overrides(config_name, sys.argv[1:])
            except ConfigError as error:
                sys.exit(f"error: {error}")
            keep_freed_memory()
            command()

        return main

    return decorate


def explain(error: BaseException) -> str | None:
    """The line that tells a person what to mend; None for errors that are no `UserError` and not of the config.

    Finds a `UserError` behind Hydra's `instantiate` and behind the traceback with which PyTorch's DataLoader hands
    on what a worker raised.
    """
    if not isinstance(error, (UserError, InstantiationException, OmegaConfBaseException)):
        return None
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) and cause not in chain:
        chain.append(cause)
    for link in chain:
        if isinstance(link, UserError):
            return str(link).rpartition(f"{type(link).__module__}.{type(link).__qualname__}: ")[2].strip()
        if isinstance(link, MissingMandatoryValue):
            return f"{link.full_key} must be given: add {link.full_key}=<value>"
    if isinstance(error, OmegaConfBaseException):
        return f"{error.full_key}: {str(error).splitlines()[0]}"
    inner = [link for link in chain if isinstance(link, InstantiationException)][-1]
    target, *details = str(inner).splitlines()
    key = next((line for line in details if line.startswith("full_key: ")), "").removeprefix("full_key: ")
    cause = f"{type(inner.__cause__).__name__}: {inner.__cause__}" if inner.__cause__ else ""
    return _one_line(f"{key}: " if key else "", target, cause)


def load_config(config_name: str, overrides: list[str]) -> DictConfig:
    """The composed config of an entry point, as its command would see it (without Hydra's own node).

    Raises:
        ConfigError: an override names no key, or its value is of the wrong kind.
    """
    check_overrides(config_name, overrides)
    return _compose(config_name, overrides)


def check_overrides(config_name: str, arguments: list[str]) -> None:
    """Check `key=value` arguments, every choice of a sweep included, before Hydra runs anything.

    Raises:
        ConfigError: see `load_config`.
    """
    words = [word for word in arguments if not word.startswith("-") and "=" in word.lstrip("~+")]
    try:
        overrides = OverridesParser.create().parse_overrides(words)
    except HydraException as error:
        raise ConfigError(f"cannot read the overrides {' '.join(words)}: {str(error).splitlines()[0]}") from error
    choices = [_choices(override) for override in overrides]
    groups = [alternatives for alternatives in choices if _is_group(alternatives[0])]
    configs = _compose_each(config_name, groups)
    for override in (choice for alternatives in choices for choice in alternatives):
        if not (_is_group(override) or override.is_add() or override.is_force_add() or override.is_delete()):
            for config in configs:
                _check_value(config, override)


def _choices(override: Override) -> list[Override]:
    """The choices of a sweep as overrides of their own; a sweep that cannot be enumerated is its own choice."""
    if not override.is_discrete_sweep() or override.value_type == ValueType.GLOB_CHOICE_SWEEP:
        return [override]
    words = [f"{override.get_key_element()}={choice}" for choice in override.sweep_string_iterator()]
    return OverridesParser.create().parse_overrides(words) or [override]


def _compose_each(config_name: str, groups: list[list[Override]]) -> list[DictConfig]:
    """A config for every choice of every group, the other groups being at their first choice."""
    groups = [choices for choices in groups if not choices[0].is_sweep_override()]
    for choice in (choice for choices in groups for choice in choices):
        _check_choice(choice)
    first = [choices[0].input_line for choices in groups]
    configs = [_composed(config_name, *first)]
    for index, choices in enumerate(groups):
        for choice in choices[1:]:
            configs.append(_composed(config_name, *first[:index], choice.input_line, *first[index + 1 :]))
    return configs


@functools.cache
def _composed(config_name: str, *choices: str) -> DictConfig:
    """The config of these choices, with Hydra's own node: to be read alone, since the next call gets it too."""
    return _compose(config_name, list(choices), with_hydra=True)


def _compose(config_name: str, overrides: list[str], with_hydra: bool = False) -> DictConfig:
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose(config_name, overrides, return_hydra_config=with_hydra)
    except MissingConfigException as error:
        choices = f"; choices: {', '.join(error.options)}" if error.options else ""
        raise ConfigError(f"there is no {error.missing_cfg_file}{choices}") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_one_line(error, error.__cause__ or "")) from error
    finally:
        GlobalHydra.instance().clear()


def _one_line(*parts: object) -> str:
    return " ".join(" ".join(map(str, parts)).split())


def _is_group(override: Override) -> bool:
    return "/" in override.key_or_group or (CONF / override.key_or_group).is_dir()


def _check_choice(override: Override) -> None:
    value, group = override.value(), override.key_or_group
    if isinstance(value, (str, list, dict)) or override.is_delete():
        return
    names = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    without = f"; to go without, say ~{group}" if value is None and group in OPTIONAL_GROUPS else ""
    raise ConfigError(f"{group} takes {' or '.join(names) or 'a name'}, got {_shown(value)}{without}")


def _check_value(config: DictConfig, override: Override) -> None:
    node, seen = config, []
    for part in override.key_or_group.split("."):
        if not isinstance(node, DictConfig) or part not in list(node):  # `in` overlooks mandatory values
            where = ".".join(seen)
            keys = sorted(map(str, node)) if isinstance(node, DictConfig) else []
            if not seen:
                keys = [key for key in keys if key != "hydra"]
            close = difflib.get_close_matches(part, keys, 1)
            raise ConfigError(
                f"{override.key_or_group} is not a key"
                + (f"; did you mean {'.'.join([*seen, close[0]])}?" if close else "")
                + f" Keys of {where or 'the config'}: {', '.join(keys) or 'none (it is a value)'}"
            )
        seen.append(part)
        raw = node._get_node(part)
        node = (
            raw
            if isinstance(raw, DictConfig)
            else OmegaConf.to_container(
                OmegaConf.create({"value": None if raw._is_missing() else raw._value()}), resolve=False
            )["value"]
        )
    if not override.is_hydra_override():  # Hydra checks its own, and lets some be of several kinds
        _check_kind(node, override)


def _check_kind(default: object, override: Override) -> None:
    """A number stays a number and a list a list; null, strings and interpolations say nothing of their kind."""
    value = override.value()
    interpolated = isinstance(value, str) and "${" in value
    if type(default) not in KINDS or value is None or interpolated or override.is_sweep_override():
        return
    if isinstance(value, EITHER.get(override.key_or_group.rpartition(".")[2], ())):
        return
    name, allowed = KINDS[type(default)]
    if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
        known = f"keys {', '.join(map(str, default))}" if isinstance(default, DictConfig) else f"default {default}"
        raise ConfigError(f"{override.key_or_group} takes {name} ({known}), got {_shown(value)}")


def _shown(value: object) -> str:
    return "null" if value is None else repr(value)
