"""The configurations of sweep=stability: each stress with severities of its own, and each strategy that it acts on."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nerfdiff.stability.breaking import sides_of
from nerfdiff.stress.axes import NONE, stress_files
from nerfdiff.sweeps.space import SEED, Axis, Space, axes_of
from nerfdiff.utils.errors import ConfigError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StressSpace:
    """First the clean configurations, then every axis's harshest severity, then the next: minutes cover all axes.

    Args:
        where: `distill` or `train`: whose stresses.
        severities: the key of a stress that has them: `severities` or `quick`.
        baselines: strategies that run clean alone.
    """

    where: str
    severities: str
    baselines: Sequence[str]

    def __call__(
        self, params: Sequence[str], arguments: Sequence[str], compose: Callable[[list[str]], DictConfig]
    ) -> Space:
        """Return the space of a command.

        Args:
            params: words of Hydra's sweep syntax: `strategy` and `seed`.
            arguments: further ones, each in place of those of its key. `stress` chooses axes.
            compose: overrides to a config.

        Raises:
            ConfigError: severities are given, an axis is not there, or another key has several values.
        """
        axes = {axis.key: axis for axis in axes_of([*params, *arguments])}
        if "stress.severity" in axes:
            raise ConfigError("stress.severity: sweep=stability takes the severities of conf/stress; leave it out")
        if several := [k for k, axis in axes.items() if axis.varies and k not in ("strategy", "stress", SEED)]:
            raise ConfigError(f"{several[0]} has several values: sweep=stability sweeps over stress, strategy and seed")
        seeds = axes.pop(SEED).words if SEED in axes else ()
        strategies = axes.pop("strategy").words if "strategy" in axes else ()
        strategies = strategies if self.where == "distill" else ()  # training has none
        chosen = self._chosen(axes.pop("stress", None))
        fixed = list(axes.values())
        words = [word for axis in fixed for word in axis.words]
        configs = {word: compose([*words, word]) for word in strategies} or {"": compose(words)}

        def branch(stress: str, severity: object, words: Sequence[str]) -> tuple[Axis, ...]:
            own = [Axis("stress", (f"stress={stress}",))]
            own += [] if severity is None else [Axis("stress.severity", (f"stress.severity={severity}",))]
            return (*own, *([Axis("strategy", tuple(words))] if words else []), *fixed)

        clean = [*strategies, *(f"strategy={name}" for name in self.baselines if strategies)]
        branches, left, columns = [branch(NONE, None, clean)], [], []
        for axis, stress in chosen.items():
            acted_on = [word for word, config in configs.items() if acts(stress, config)]
            acted_on += [word for word in clean[len(strategies) :] if stress.own_scenes]
            if stress.left_out:
                left.append(f"{axis}: {stress.left_out}")
            if acted_on:
                several, missing = severities_of(stress, next(iter(configs.values())), self.severities)
                left += [f"{axis} at {severity:g}: there is no {folder}" for severity, folder in missing.items()]
                columns.append([branch(axis, severity, [w for w in acted_on if w]) for severity in several])
        branches += [each for rank in zip_longest(*columns) for each in rank if each is not None]
        for line in left:
            log.info("left out: %s", line)
        return Space(tuple(branches), ("stress", "strategy"), seeds)

    def _chosen(self, asked: Axis | None) -> dict[str, DictConfig]:
        known = {axis: stress for axis, stress in stress_files().items() if stress.where == self.where}
        names = list(known) if asked is None else [word.partition("=")[2] for word in asked.words]
        if unknown := [name for name in names if name not in known]:
            raise ConfigError(f"stress={unknown[0]}: choose among {', '.join(known)}")
        return {name: known[name] for name in names}


def severities_of(stress: DictConfig, config: DictConfig, key: str) -> tuple[list[float | int], dict[float | int, str]]:
    """Return the severities of an axis, the harshest of either side first, without the neutral one of this config.

    Those that lack a folder that they require are apart, with the folder.
    """
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=False))
    del resolved["hydra"]
    resolved.stress = stress
    neutral = resolved.stress.neutral
    required = {float(severity): str(folder) for severity, folder in resolved.stress.requires.items()}
    missing = {s: required[s] for s in stress[key] if s in required and not Path(required[s]).is_dir()}
    wanted = [severity for severity in stress[key] if severity != neutral and severity not in missing]
    sides = sides_of(wanted, neutral, stress.ordered)
    ranks = zip_longest(*(reversed(side) for side in sides.values()))
    return [severity for rank in ranks for severity in rank if severity is not None], missing


def acts(stress: DictConfig, config: DictConfig) -> bool:
    """Return true if a stress acts on the strategy of a config: it has one of the keys that the stress needs."""

    def has(key: str) -> bool:
        parent, _, last = key.rpartition(".")
        node = OmegaConf.select(config, parent)
        return isinstance(node, DictConfig) and last in list(node)

    return not stress.needs or any(map(has, stress.needs))
