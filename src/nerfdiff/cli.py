"""Common parts of the entry points: overrides checked before anything runs, and errors a person can read."""

import difflib
import functools
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from itertools import pairwise
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

from nerfdiff.inputs import CHECKOUT, CONF, NO_SCENE, check_inputs, check_output
from nerfdiff.limits import check_limit, check_limits
from nerfdiff.noise import quieten
from nerfdiff.quoting import gather_lists, parse_override, quote_values
from nerfdiff.stopping import Stopped, in_a_job, leave, on_signals, stop
from nerfdiff.utils.errors import ConfigError, UserError, is_out_of_memory
from nerfdiff.utils.hashes import sha256_values
from nerfdiff.utils.memory import keep_freed_memory

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
    "devices": (int, list),
}
OPTIONAL_GROUPS = ("logger", "experiment", "sweep")
MULTIRUN = ("-m", "--multirun")
# Options with which a command shows something and runs nothing, or runs another config.
SHOWING = ("-h", "--help", "--hydra-help", "--version", "-c", "--cfg", "-i", "--info")
OTHER_CONFIG = ("-cp", "--config-path", "-cn", "--config-name", "--experimental-rerun")
CONFIG_DIR = ("-cd", "--config-dir")
SEARCHPATH = "hydra.searchpath"
COMPLETING = ("-sc", "--shell-completion")
EXCLUDED = "hydra.job.config.override_dirname.exclude_keys"
MAX_FOLDER = 100
"""Characters of the name of a sweep's job before its hash; file systems take 255 bytes."""


def entry_point(config_name: str, *inputs: str) -> Callable[[Callable[[DictConfig], object]], Callable[[], None]]:
    """Make a function of a config into a command.

    Values that Hydra's grammar would misread are quoted for it. Overrides are checked against the composed defaults:
    an unknown key or a value of the wrong kind ends the command with the keys that exist, and so does a checkpoint,
    picture or folder that is not there, before anything slow is imported. What `explain` knows ends it with one line
    and exit status 1; HYDRA_FULL_ERROR=1 gives the traceback instead.

    Args:
        config_name: of the file in conf/.
        inputs: keys of what the command reads, see `check_inputs`.
    """

    def decorate(function: Callable[[DictConfig], object]) -> Callable[[], None]:
        @functools.wraps(function)
        def run(cfg: DictConfig) -> object:
            quieten()
            try:
                with in_a_job():
                    return function(cfg)
            except Exception as error:
                message = explain(error, cfg)
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
                sys.argv[1:] = prepare_arguments(config_name, inputs, sys.argv[1:])
            except UserError as error:
                sys.exit(f"error: {error}")
            keep_freed_memory()
            command()

        @functools.wraps(function)
        def stoppable() -> None:
            words = shlex.join([*command_words(config_name), *sys.argv[1:]])
            try:
                with on_signals(stop):
                    main()
            except Stopped as stopped:
                leave(stopped, words)

        return stoppable

    return decorate


def command_words(name: str) -> list[str]:
    """The shell command of an entry point: from the project's folder, or as it is installed."""
    return ["python", f"src/{name}.py"] if CHECKOUT else [f"nerfdiff-{name.replace('_', '-')}"]


def job_folder(swept: str, overrides: Sequence[str] = ()) -> str:
    """The name of the folder of a sweep's job, which every file system takes and which may stand in an override.

    Args:
        swept: the overrides that tell the sweep's jobs apart; they name it.
        overrides: others that the hash at the name's end is of as well.
    """
    name = re.sub(r"[^a-zA-Z0-9_.]+", "-", swept)[:MAX_FOLDER].strip("-.")
    return "-".join(filter(None, [name, sha256_values([swept, *sorted(overrides)])[:8]]))


def group_lines(*groups: str, without: Collection[str] = ()) -> str:
    """Config groups with their choices, as a command's help shows them."""
    width = max(map(len, groups)) + 4
    lines = (f"  {group}".ljust(width) + ", ".join(n for n in choices(group) if n not in without) for group in groups)
    return "\n".join(textwrap.fill(line, 100, subsequent_indent=" " * width, break_on_hyphens=False) for line in lines)


OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)
# of the commands' help
OmegaConf.register_new_resolver("command", lambda name: " ".join(command_words(name)), replace=True)
OmegaConf.register_new_resolver("groups", group_lines, replace=True)
OmegaConf.register_new_resolver("scene_groups", functools.partial(group_lines, without=NO_SCENE), replace=True)
OmegaConf.register_new_resolver("all_shards", lambda of: ",".join(f"{n}/{of}" for n in range(1, of + 1)), replace=True)


def explain(error: BaseException, cfg: DictConfig | None = None) -> str | None:
    """The line that tells a person what to mend; None for errors that nobody but a developer can mend.

    Finds a `UserError` behind Hydra's `instantiate` and behind the traceback with which PyTorch's DataLoader hands
    on what a worker raised. Files and memory that the system refuses are a person's to mend, too.

    Args:
        cfg: of the command, of which memory's advice names the keys.
    """
    if not isinstance(error, UserError) and (refused := _refused(error, cfg)):
        return refused
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
        return (f"{error.full_key}: " if error.full_key else "") + str(error).splitlines()[0]
    inner = [link for link in chain if isinstance(link, InstantiationException)][-1]
    target, *details = str(inner).splitlines()
    key = next((line for line in details if line.startswith("full_key: ")), "").removeprefix("full_key: ")
    cause = f"{type(inner.__cause__).__name__}: {inner.__cause__}" if inner.__cause__ else ""
    return _one_line(f"{key}: " if key else "", target, cause)


def _refused(error: BaseException, cfg: DictConfig | None) -> str | None:
    """Name what the system would not give: a file, or memory."""
    if is_out_of_memory(error):
        known = ("data.batch_size", "budget.rays", "budget.views", "strategy.views_at_once", "scenes_at_once", "chunk")
        keys = [key for key in known if cfg is not None and OmegaConf.select(cfg, key, default=None) is not None]
        lower = f": lower {', '.join(keys)}" if keys else ""
        return _one_line("memory ran out", f"({str(error).splitlines()[0][:200]})" if str(error) else "") + lower
    if isinstance(error, OSError):
        what = error.strerror or _last_line(error) or type(error).__name__
        return _one_line(f"{error.filename}: " if error.filename else "", what)
    if isinstance(error, RuntimeError) and "Symlink loop" in str(error):  # pathlib's
        return _last_line(error)
    return None


def _last_line(error: BaseException) -> str:
    """Return the last line of an error: where a DataLoader's worker raised it, the lines before are a traceback."""
    return (str(error).strip().splitlines() or [""])[-1]


def load_config(config_name: str, overrides: list[str]) -> DictConfig:
    """The composed config of an entry point, as its command would see it (without Hydra's own node).

    Raises:
        ConfigError: an override names no key, or its value is of the wrong kind, or a number that no run can have.
    """
    overrides = quote_values(gather_lists(config_name, overrides))
    check_overrides(config_name, overrides)
    config = _compose(config_name, overrides)
    check_limits(config)
    return config


def prepare_arguments(config_name: str, inputs: Sequence[str], arguments: list[str]) -> list[str]:
    """A command's arguments as Hydra is to read them, after they were checked.

    Raises:
        UserError: they are wrong, or a file or folder that they name is not there.
    """
    options = {word.partition("=")[0] for word in arguments if word.startswith("-")}
    if not options.isdisjoint(COMPLETING):
        return arguments
    arguments = quote_values(gather_lists(config_name, arguments))
    check_overrides(config_name, arguments)
    if not options.isdisjoint((*SHOWING, *OTHER_CONFIG)):
        return arguments
    overrides = _overrides(arguments)
    swept = {override.key_or_group for override in overrides if override.is_sweep_override()}
    fixed = {override.key_or_group: override for override in overrides if override.key_or_group not in swept}
    words = [
        *_searchpath(arguments),
        *(_choices(override)[0].input_line for override in overrides if _is_group(override)),
    ]
    words += [override.input_line for key, override in fixed.items() if not _is_group(override) and key != SEARCHPATH]
    config = _compose(config_name, words, with_hydra=True)
    if options.isdisjoint(MULTIRUN) and config.hydra.mode != RunMode.MULTIRUN:
        check_limits(config)
        check_inputs(config, inputs)
        check_output(config)
        return arguments
    check_inputs(config, inputs, swept=swept | set(config.hydra.sweeper.get("params") or ()), only=fixed)
    # jobs, in whatever process, are to name their folders by what is swept
    untold = [key for key, override in fixed.items() if not override.is_hydra_override()]
    # beside other overrides: argparse takes them from one place only, be it before -m or behind it
    places = [n for n, word in enumerate(arguments, 1) if not word.startswith("-") and "=" in word]
    place = places[-1] if places else len(arguments)
    return [*arguments[:place], f"{EXCLUDED}=[{','.join(untold)}]", *arguments[place:]]


def _overrides(arguments: list[str]) -> list[Override]:
    """The `key=value` words among a command's arguments.

    Raises:
        ConfigError: Hydra cannot read one, or a word is none.
    """
    for before, word in pairwise(["", *arguments]):
        if not word.startswith(("-", "~")) and "=" not in word and not before.startswith("-"):
            raise ConfigError(f"{word} says no key: write key={word}, without spaces around =")
    words = [word for word in arguments if not word.startswith("-") and "=" in word.lstrip("~+")]
    for word in words:
        if parse_override(word) is None:
            key, _, value = word.partition("=")
            quoted = shlex.quote(f'{key}="{value}"')
            raise ConfigError(f"cannot read the override {word}; if its value is text, quote all of it: {quoted}")
    return OverridesParser.create().parse_overrides(words)


def check_overrides(config_name: str, arguments: list[str]) -> None:
    """Check `key=value` arguments, every choice of a sweep included, before Hydra runs anything.

    Raises:
        ConfigError: see `load_config`.
    """
    choices = [_choices(override) for override in _overrides(arguments)]
    groups = [alternatives for alternatives in choices if _is_group(alternatives[0])]
    configs = _compose_each(config_name, groups, _searchpath(arguments))
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


def _searchpath(arguments: list[str]) -> list[str]:
    """The override, if any, with which Hydra also looks for configs where the arguments say.

    Raises:
        ConfigError: the folder of `--config-dir` is not there.
    """
    folders = []
    for word, following in pairwise([*arguments, ""]):
        option, given, value = word.partition("=")
        if option in CONFIG_DIR:
            folder = Path(value if given else following).absolute()
            if not folder.is_dir():
                raise ConfigError(f"{option} {folder}: no such folder; name a folder in the form of {CONF}")
            folders.append(f"file://{folder}")
        elif option == SEARCHPATH and (override := parse_override(word)):
            folders += override.value()
    return [f"{SEARCHPATH}={folders}"] if folders else []


def _compose_each(config_name: str, groups: list[list[Override]], search: list[str]) -> list[DictConfig]:
    """A config for every choice of every group, the other groups being at their first choice."""
    groups = [choices for choices in groups if not choices[0].is_sweep_override()]
    for choice in (choice for choices in groups for choice in choices):
        _check_choice(choice)
    first = [*search, *(choices[0].input_line for choices in groups)]
    configs = [_composed(config_name, *first)]
    for index, choices in enumerate(groups, len(search)):
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
        listed = ", ".join(error.options or ())
        close = difflib.get_close_matches(str(error.missing_cfg_file).rpartition("/")[2], error.options or (), 1)
        others = f"; did you mean {close[0]}? Choices: {listed}" if close else f"; choices: {listed}" if listed else ""
        raise ConfigError(f"there is no {error.missing_cfg_file}{others}") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_one_line(error, error.__cause__ or "")) from error
    finally:
        GlobalHydra.instance().clear()


def _one_line(*parts: object) -> str:
    return " ".join(" ".join(map(str, parts)).split())


def _is_group(override: Override) -> bool:
    return "/" in override.key_or_group or (CONF / override.key_or_group).is_dir()


def choices(group: str) -> list[str]:
    """The names that a config group has in conf/."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _check_choice(override: Override) -> None:
    value, group = override.value(), override.key_or_group
    if isinstance(value, (str, list, dict)) or override.is_delete():
        return
    names = choices(group)
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
                + (
                    f"; did you mean {'.'.join([*seen, close[0]])}? --cfg job shows all"
                    if close
                    else f". Keys of {where or 'the config'}: {', '.join(keys) or 'none (it is a value)'}"
                )
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
    if isinstance(node, str) and "${" in node:  # a number that is another key's is a number as well
        with suppress(OmegaConfBaseException, ValueError):
            resolved = OmegaConf.select(config, override.key_or_group)
            node = resolved if isinstance(resolved, int | float) else node
    if not override.is_hydra_override():  # Hydra checks its own, and lets some be of several kinds
        _check_kind(node, override)


def _check_kind(default: object, override: Override) -> None:
    """A number stays a number and a list a list; null, strings and interpolations say nothing of their kind."""
    value = override.value()
    interpolated = isinstance(value, str) and "${" in value
    _check_type(default, override, value, interpolated)
    if not override.is_sweep_override() and "${" not in str(value):
        check_limit(override.key_or_group, value)


def _check_type(default: object, override: Override, value: object, interpolated: bool) -> None:
    of_several = EITHER.get(override.key_or_group.rpartition(".")[2], ())
    if isinstance(default, str) and "${" not in default and isinstance(value, (list, dict)):
        if not isinstance(value, of_several):
            raise ConfigError(f"{override.key_or_group} takes text (default {default}), got {_shown(value)}")
        return
    if type(default) not in KINDS or value is None or interpolated or override.is_sweep_override():
        return
    if isinstance(value, of_several):
        return
    name, allowed = KINDS[type(default)]
    if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
        known = f"keys {', '.join(map(str, default))}" if isinstance(default, DictConfig) else f"default {default}"
        raise ConfigError(f"{override.key_or_group} takes {name} ({known}), got {_shown(value)}")


def _shown(value: object) -> str:
    return "null" if value is None else repr(value)
