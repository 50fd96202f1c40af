"""Breaking points: the smallest severity of an axis at which a strategy fails, as docs/stability.md defines it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from nerfdiff.results.intervals import Bootstrap, Estimate

LOW, HIGH = "below", "above"


@dataclass(frozen=True)
class Rules:
    """When a strategy is broken.

    Args:
        failed: share of scenes that fell back, are not finite or have no result (rule a).
        clean: dB under its own clean result (rule b); under the better baseline it is broken as well.
        harm: dB under `none` at the same severity (rule c).
        frechet: times the clean Fréchet distance (rule d).
    """

    failed: float
    clean: float
    harm: float
    frechet: float


@dataclass(frozen=True)
class Outcome:
    """The result of one scene with one seed.

    Args:
        psnr: NaN where there is no result.
        status: `ok`, or why the scene fell back or has no result.
        verdict: of the judge: `ok`, or `suspect: <why>`; None where it did not look.
    """

    psnr: float
    status: str = "ok"
    verdict: str | None = None

    @property
    def failed(self) -> bool:
        return self.status != "ok" or not math.isfinite(self.psnr)

    @property
    def told(self) -> bool:
        """True if a user is told that something is wrong."""
        return self.failed or (self.verdict or "ok") != "ok"


Outcomes = Mapping[tuple[int, str], Outcome]
"""Results of a strategy at one severity, by seed and scene."""


@dataclass(frozen=True)
class Failure:
    """A scene that rule b or c holds for, by itself.

    Args:
        rules: b, c or both.
        loss: against its own clean result, in dB; None for other scenes.
        harm: against `none` at the same severity, in dB; None for `none` itself.
        clean_harm: against `none` without stress, in dB; None where it is not known.
        told: a user is told that something is wrong. If not, the failure is silent.
    """

    seed: int
    scene: str
    rules: str
    loss: float | None
    harm: float | None
    clean_harm: float | None
    told: bool


@dataclass(frozen=True)
class Point:
    """A strategy at one severity of an axis.

    Args:
        psnr: its mean and interval over scenes and seeds, in dB; of scenes that fell back too.
        without_fallbacks: the mean of the others; None without any.
        loss: against its own clean result, scene by scene: mean and interval, in dB; None for other scenes.
        failed, total: scenes (times seeds) that fell back, are not finite or have no result, of how many.
        suspect: scenes that the judge suspects.
        broken: the rules (a to d) that hold.
        failures: scenes that rule b or c holds for, by themselves.
        frechet: mean over seeds; None where it was not measured.
    """

    severity: float
    psnr: Estimate
    without_fallbacks: float | None
    loss: Estimate | None
    failed: int
    total: int
    suspect: int
    broken: str
    failures: tuple[Failure, ...]
    frechet: float | None

    @property
    def silent(self) -> tuple[Failure, ...]:
        """Return the failures whose status and verdict both say ok."""
        return tuple(failure for failure in self.failures if not failure.told)


@dataclass(frozen=True)
class Breaking:
    """The breaking point on one side of the neutral severity.

    Args:
        side: `below` or `above`.
        severity: the first that is broken, from neutral outwards; None: none that was tested.
        interval: of it over scenes and seeds; an end is None where draws did not break within what was tested.
        rules: that hold there.
        scene: the first that fails there.
        furthest: the last severity that was tested.
        share: of the tested severities that it withstands, 1 being all.
    """

    side: str
    severity: float | None
    interval: tuple[float | None, float | None]
    rules: str
    scene: str | None
    furthest: float
    share: float


def sides_of(severities: Sequence[float], neutral: float | None, ordered: bool) -> dict[str, list[float]]:
    """Severities by side of the neutral one, each side from neutral outwards; kinds are one side, as they stand."""
    if not ordered or neutral is None:
        return {HIGH: list(severities)}
    low = sorted((s for s in severities if s < neutral), reverse=True)
    high = sorted(s for s in severities if s > neutral)
    return {side: found for side, found in ((LOW, low), (HIGH, high)) if found}


@dataclass(frozen=True)
class Judged:
    """A strategy's runs at one severity, and all that it is compared with; see `point_of`.

    Args:
        clean: its own without stress; empty where the scenes are others.
        none: of strategy `none` at the same severity; empty for `none` itself.
        clean_none: of strategy `none` without stress, likewise.
        baseline: PSNR of the better baseline, by scene.
        frechet, clean_frechet: Fréchet distances, one per seed.
    """

    severity: float
    outcomes: Outcomes
    clean: Outcomes
    none: Outcomes
    baseline: Mapping[str, float]
    frechet: Sequence[float] = ()
    clean_frechet: Sequence[float] = ()
    clean_none: Outcomes = field(default_factory=dict)


def point_of(judged: Judged, rules: Rules, bootstrap: Bootstrap) -> Point:
    """Say what became of a strategy at one severity."""
    outcomes = judged.outcomes
    measured = {key: outcome.psnr for key, outcome in outcomes.items() if math.isfinite(outcome.psnr)}
    sound = [outcome.psnr for outcome in outcomes.values() if not outcome.failed]
    losses = _paired(judged.clean, outcomes)
    holds = _holding(judged, rules, None)
    return Point(
        severity=judged.severity,
        psnr=_estimate(_table(measured), bootstrap),
        without_fallbacks=float(np.mean(sound)) if sound else None,
        loss=_estimate(_table(losses), bootstrap) if losses else None,
        failed=sum(outcome.failed for outcome in outcomes.values()),
        total=len(outcomes),
        suspect=sum((outcome.verdict or "ok") != "ok" for outcome in outcomes.values()),
        broken="".join(rule for rule, true in holds.items() if bool(np.all(true))),
        failures=tuple(_failures(judged, rules)),
        frechet=float(np.mean(judged.frechet)) if judged.frechet else None,
    )


def breaking_point(side: str, along: Sequence[Judged], rules: Rules, bootstrap: Bootstrap) -> Breaking:
    """Find the first severity that is broken, and its interval.

    Args:
        along: one side of an axis, from the neutral severity outwards.
    """
    severities = [judged.severity for judged in along]
    exact = [_holding(judged, rules, None) for judged in along]
    at = next((n for n, holds in enumerate(exact) if any(bool(np.all(true)) for true in holds.values())), None)
    drawn = np.stack([np.any(list(_holding(judged, rules, bootstrap).values()), axis=0) for judged in along])
    drawn = drawn.reshape(len(along), -1)
    first = np.where(drawn.any(0), drawn.argmax(0), len(along))
    tail = (1 - bootstrap.level) / 2
    ends = np.quantile(first, [tail, 1 - tail], method="nearest").astype(int)
    low, high = (None if end >= len(along) else severities[end] for end in ends)
    scene = None
    if at is not None:
        judged = along[at]
        failed = [key for key, outcome in judged.outcomes.items() if outcome.failed]
        broken = [(failure.seed, failure.scene) for failure in _failures(judged, rules)]
        found = sorted({*failed, *broken}) or sorted(judged.outcomes)
        scene = found[0][1] if found else None
    return Breaking(
        side=side,
        severity=None if at is None else severities[at],
        interval=(low, high),
        rules="" if at is None else "".join(rule for rule, true in exact[at].items() if bool(np.all(true))),
        scene=scene,
        furthest=severities[-1],
        share=1.0 if at is None else at / len(along),
    )


def area(points: Sequence[Point], of_none: Sequence[Point]) -> float | None:
    """Mean over severities of the loss against clean, divided by that of `none`; None where it loses nothing."""
    own = [point.loss.mean for point in points if point.loss is not None]
    theirs = [point.loss.mean for point in of_none if point.loss is not None]
    if not own or not theirs or np.mean(theirs) <= 0.05:  # dB: a ratio of noise says nothing
        return None
    return float(np.mean(own) / np.mean(theirs))


def _holding(judged: Judged, rules: Rules, bootstrap: Bootstrap | None) -> dict[str, np.ndarray]:
    """Tell which rules hold: for all scenes, or for each of the bootstrap's draws of them."""

    def mean(values: Mapping[tuple[int, str], float]) -> np.ndarray:
        table = _table(values)
        if not table.size:
            return np.array([np.nan])
        if bootstrap is None or np.isnan(table).any() or table.size < 2:
            return np.array([np.nanmean(table)])
        return bootstrap.means(table)

    psnr = {key: o.psnr for key, o in judged.outcomes.items() if math.isfinite(o.psnr)}
    baseline = {key: value - judged.baseline[key[1]] for key, value in psnr.items() if key[1] in judged.baseline}
    with np.errstate(invalid="ignore"):
        holds = {
            "a": mean({key: float(o.failed) for key, o in judged.outcomes.items()}) >= rules.failed,
            "b": mean(_paired(judged.clean, judged.outcomes)) >= rules.clean,
            "c": mean(_paired(judged.none, judged.outcomes)) >= rules.harm,
        }
        under = mean(baseline) < 0
        holds["b"] = np.logical_or(*np.broadcast_arrays(holds["b"], under))
    ratio = np.mean(judged.frechet) / np.mean(judged.clean_frechet) if judged.frechet and judged.clean_frechet else 0.0
    holds["d"] = np.array([ratio >= rules.frechet])
    size = max(len(value) for value in holds.values())
    return {rule: np.broadcast_to(value, size) for rule, value in holds.items()}


def _failures(judged: Judged, rules: Rules) -> list[Failure]:
    """List the scenes that rule b or c holds for by themselves; those without a result have neither loss nor harm."""
    found = []
    for (seed, scene), outcome in sorted(judged.outcomes.items()):
        own, none, clean_none = (
            _of(outcomes, (seed, scene)) for outcomes in (judged.clean, judged.none, judged.clean_none)
        )
        loss = None if own is None else own - outcome.psnr
        harm = None if none is None else none - outcome.psnr
        clean_harm = None if own is None or clean_none is None else clean_none - own
        under = outcome.psnr < judged.baseline.get(scene, -math.inf)
        broken = {"b": under or (loss or 0) >= rules.clean, "c": (harm or 0) >= rules.harm}
        if any(broken.values()):
            rule = "".join(name for name, holds in broken.items() if holds)
            found.append(Failure(seed, scene, rule, loss, harm, clean_harm, outcome.told))
    return found


def _of(outcomes: Outcomes, key: tuple[int, str]) -> float | None:
    """Return a scene's PSNR with this seed, or with any where the strategy draws nothing and has one alone."""
    found = outcomes.get(key) or next((o for (_, scene), o in outcomes.items() if scene == key[1]), None)
    return None if found is None or not math.isfinite(found.psnr) else found.psnr


def _paired(first: Outcomes, second: Outcomes) -> dict[tuple[int, str], float]:
    """Return by how many dB the second are lower, in scenes that both have."""
    pairs = {key: (_of(first, key), outcome.psnr) for key, outcome in second.items()}
    return {key: a - b for key, (a, b) in pairs.items() if a is not None and math.isfinite(b)}


def _table(values: Mapping[tuple[int, str], float]) -> Float[np.ndarray, "seeds scenes"]:
    """Arrange by seed and scene, NaN where one is missing."""
    seeds, scenes = sorted({seed for seed, _ in values}), sorted({scene for _, scene in values})
    return np.array([[values.get((seed, scene), np.nan) for scene in scenes] for seed in seeds], np.float64).reshape(
        len(seeds), len(scenes)
    )


def _estimate(table: Float[np.ndarray, "seeds scenes"], bootstrap: Bootstrap) -> Estimate:
    if not table.size:
        return Estimate(math.nan)
    if np.isnan(table).any():
        return Estimate(float(np.nanmean(table)))
    return bootstrap.over_seeds_and_scenes(table[None])[0]
