"""Compare configurations with the reference strategy of the same model, scene by scene."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from nerfdiff.metrics.table import METRICS
from nerfdiff.results.frame import Configuration
from nerfdiff.results.intervals import Bootstrap, Estimate
from nerfdiff.results.paired import difference
from nerfdiff.results.row import ResultRow

MODEL = ("ckpt_sha256", "weights", "model", "field")
GEOMETRY = ("floaters", "depth_extent", "depth_abs_rel", "mask_iou")  # of fields alone
WITHOUT_FIELD = ("cdm", "copy_input", "mean_image")


def references_of(members: Sequence[int], found: Sequence[Configuration], strategy: str) -> dict[int, int | None]:
    """For each member that of `strategy` with the same model which shares most settings; None where there is none."""
    nones = [number for number in members if found[number].row.strategy == strategy]

    def same_model(number: int, other: int) -> bool:
        pairs = [(getattr(found[number].row, name), getattr(found[other].row, name)) for name in MODEL]
        return all(a == b or a is None or b is None for a, b in pairs)  # a baseline has no model

    def shared(number: int, other: int) -> int:
        return len(set(found[number].settings) & set(found[other].settings))

    return {
        number: number
        if number in nones
        else max((n for n in nones if same_model(number, n)), key=partial(shared, number), default=None)
        for number in members
    }


def leave_fields(members: Sequence[int], found: Sequence[Configuration]) -> dict[int, bool]:
    """Tell whether each configuration leaves a field (rather than views alone), as far as its row tells.

    Rows do not say it outright. A field has geometry to measure, and was fitted to K views where the denoiser was
    asked; baselines query none. Where no row of the panel has either, the strategy's name alone says it.
    """
    rows = {number: found[number].row for number in members}
    tells = {
        n: row.K is not None or any(row.measured(name) is not None for name in GEOMETRY) for n, row in rows.items()
    }
    some = any(tells.values())

    def leaves(row: ResultRow) -> bool:
        if row.field_queries == 0 or row.strategy in WITHOUT_FIELD:
            return False
        return not row.denoiser_calls or not some

    return {number: tells[number] or leaves(row) for number, row in rows.items()}


def has_interval(estimate: Estimate) -> bool:
    return all(value is not None and math.isfinite(value) for value in estimate)


@dataclass
class Leads:
    """Differences between configurations, scene by scene; every one is computed once.

    Args:
        fewest: scenes below which there is no interval: by chance alone n differences have one sign in one case of
            2^(n-1), which no bootstrap of them sees.
    """

    found: Sequence[Configuration]
    bootstrap: Bootstrap
    fewest: int
    known: dict[tuple[str, int, int], Estimate | None] = field(default_factory=dict)

    def __call__(self, metric: str, number: int, other: int) -> Estimate | None:
        """Return how much more of the metric `number` has than `other`; None where there are no values of scenes."""
        key = metric, number, other
        if key not in self.known:
            own, theirs = (self.found[each].scenes.get(metric, {}) for each in (number, other))
            estimate = difference(own, theirs, self.bootstrap)
            few = len(own.keys() & theirs.keys()) < self.fewest
            self.known[key] = Estimate(estimate.mean) if estimate is not None and few else estimate
        return self.known[key]

    def verdict(self, metric: str, number: int, other: int) -> str | None:
        """`better`, `level` or `worse`, as the interval says; None without an interval."""
        if number == other:
            return "level"
        found = self(metric, number, other)
        if found is None or not has_interval(found):
            return None
        ends = sorted(METRICS[metric].sign * end for end in (found.low, found.high))
        return "better" if ends[0] > 0 else "worse" if ends[1] < 0 else "level"

    def level_with(self, metric: str, best: int, among: Sequence[int]) -> list[int]:
        """Return `best` and those `among` that no interval tells from it."""
        return [number for number in among if number == best or self.verdict(metric, best, number) == "level"]


def differences_to(
    number: int,
    reference: int | None,
    estimates: Sequence[Mapping[str, Estimate]],
    metrics: Sequence[str],
    leads: Leads,
) -> dict[str, Estimate]:
    """Differences to the reference: with intervals where both have values of scenes, else those of the means."""
    if reference is None or reference == number:
        return {}
    own, theirs = estimates[number], estimates[reference]
    found = {}
    for metric in metrics:
        if metric in own and metric in theirs:
            paired = leads(metric, number, reference)
            alone = Estimate(own[metric].mean - theirs[metric].mean)
            found[metric] = paired if paired is not None and has_interval(paired) else alone
    return found
