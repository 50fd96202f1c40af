"""What the entry points share: overrides checked before anything runs, and errors a person can read."""

import difflib
import functools
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfdiff.errors import ConfigError, UserError

CONF = Path(__file__).parents[2] / "conf"


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], object]], Callable[[], None]]:
    """Make a function of a config into a command.

    Overrides are checked against the composed defaults: an unknown key or a value of the wrong kind ends the
    command with the keys that exist. A `UserError` ends it with one line and exit status 1.
    """

    def decorate(function: Callable[[DictConfig], object]) -> Callable[[], None]:
        @functools.wraps(function)
        def run(cfg: DictConfig) -> object:
            try:
                return function(cfg)
            except UserError as error:
                sys.exit(f"error: {error}")

        command = hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)(run)

        @functools.wraps(function)
        def main() -> None:
            try:
                check_overrides(config_name, sys.argv[1:])
            except ConfigError as error:
                sys.exit(f"error: {error}")
            command()

        return main

    return decorate


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
    groups = [o for o in overrides if _is_group(o)]
    base = _compose(config_name, [_first_choice(o) for o in groups], with_hydra=True)
    for override in overrides:
        if not (_is_group(override) or override.is_add() or override.is_delete()):
            _check_value(base, override)


def _compose(config_name: str, overrides: list[str], with_hydra: bool = False) -> DictConfig:
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose(config_name, overrides, return_hydra_config=with_hydra)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(str(error)) from error
    finally:
        GlobalHydra.instance().clear()


def _is_group(override: Override) -> bool:
    return (CONF / override.key_or_group.partition("@")[0]).is_dir()


def _first_choice(override: Override) -> str:
    choices = list(override.sweep_string_iterator()) if override.is_sweep_override() else []
    return f"{override.get_key_element()}={choices[0]}" if choices else override.input_line


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
    _check_kind(node, override)


def _check_kind(default: object, override: Override) -> None:
    """A number stays a number and a switch a switch; null, strings and interpolations say nothing of their kind."""
    kinds = {bool: (bool,), int: (int,), float: (int, float)}
    values = override.sweep_iterator() if override.is_sweep_override() else [override.value()]
    allowed = kinds.get(type(default))
    for value in values:
        interpolated = isinstance(value, str) and "${" in value
        wrong_bool = isinstance(value, bool) and allowed is not None and bool not in allowed
        if allowed and not interpolated and value is not None and (wrong_bool or not isinstance(value, allowed)):
            raise ConfigError(
                f"{override.key_or_group} takes {' or '.join(k.__name__ for k in allowed)} "
                f"(default {default}), got {value!r}"
            )
