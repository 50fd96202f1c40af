"""Three configurations to begin with: a fast one, a balanced one and a sharp one, none of them for a lead of noise."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from nerfdiff.chart.against import Leads
from nerfdiff.metrics.table import METRICS
from nerfdiff.results.intervals import Estimate

NO_INTERVALS = (
    "no pick: a lead is told from noise by values per scene (scores/<strategy>/per_scene.csv), of at least {} scenes"
)


@dataclass(frozen=True)
class Pick:
    """A configuration's number, or None, and why, in one sentence."""

    name: str
    number: int | None
    reason: str


@dataclass(frozen=True)
class Picker:
    """Picks among configurations of one panel.

    Fast: the cheapest whose fidelity is not below the reference's. Balanced: the best fidelity of those that are
    sharper than the reference. Sharp: the sharpest. Of those that are level with the best, the cheapest is picked.

    Args:
        estimates, names: per configuration; estimates in the page's units.
        fidelity, sharpness: metrics; `sharpness` is None where none was measured.
        cost: what is paid, as conf/chart.yaml has it.
        reference: the configuration of the reference strategy.
    """

    estimates: Sequence[Mapping[str, Estimate]]
    names: Sequence[str]
    leads: Leads
    fidelity: str
    sharpness: str | None
    cost: Mapping[str, Any]
    reference: int | None

    def __call__(self, members: Sequence[int]) -> list[dict[str, Any]]:
        """The three picks, as the page has them."""
        able = [n for n in members if self.cost["field"] in self.estimates[n] and self._has(n, self.fidelity)]
        if not any(len(self.leads.found[n].scenes[self.fidelity]) >= self.leads.fewest for n in able):
            reason = NO_INTERVALS.format(self.leads.fewest)
            return [asdict(Pick(name, None, reason)) for name in ("fast", "balanced", "sharp")]
        return [asdict(pick) for pick in (self._fast(able), self._balanced(able), self._sharp(able))]

    def _fast(self, able: Sequence[int]) -> Pick:
        if self.reference is None:
            return Pick("fast", None, "no pick: no run here is of the reference to compare with")
        kept = [n for n in able if self.leads.verdict(self.fidelity, n, self.reference) in ("better", "level")]
        if not kept:
            return Pick("fast", None, f"no pick: nothing here has a {self._label(self.fidelity)} to compare")
        chosen = min(kept, key=self._price)
        if chosen == self.reference:
            told = f"{self._paid(chosen)} and no distillation: nothing cheaper keeps its {self._label(self.fidelity)}."
            return Pick("fast", chosen, told)
        told = f"{self._label(self.fidelity)} is not below that of {self._name()}"
        lead = _signed(self.leads(self.fidelity, chosen, self.reference), self.fidelity)
        return Pick("fast", chosen, f"{self._paid(chosen)}: the least of all whose {told} ({lead}).")

    def _balanced(self, able: Sequence[int]) -> Pick:
        sharper = [n for n in able if self._sharper(n)]
        what = self._label(self.fidelity) + (
            f" of all with a better {self._label(self.sharpness)} than {self._name()}" if sharper else ""
        )
        return self._best("balanced", self.fidelity, sharper or able, what)

    def _sharp(self, able: Sequence[int]) -> Pick:
        if self.sharpness is None:
            return Pick("sharp", None, "no pick: no perceptual distance was measured")
        there = [n for n in able if self._has(n, self.sharpness)]
        return self._best("sharp", self.sharpness, there, self._label(self.sharpness))

    def _best(self, name: str, metric: str, among: Sequence[int], what: str) -> Pick:
        if not among:
            return Pick(name, None, f"no pick: nothing here has a {what}")
        best = max(among, key=lambda n: (METRICS[metric].sign * self.estimates[n][metric].mean, -self._price(n)))
        level = self.leads.level_with(metric, best, among)
        chosen = min(level, key=lambda n: (self._price(n), n != best))
        against = self._against(metric, chosen)
        told = f" ({against})" if against else ""
        if chosen == best:
            rest = "" if len(among) == 1 else "; nothing cheaper is level with it"
            return Pick(name, chosen, f"The best {what}{told}, for {self._paid(chosen)}{rest}.")
        lead = _signed(self.leads(metric, chosen, best), metric)
        return Pick(
            name,
            chosen,
            f"Level with the best {what}, of {self.names[best]} ({lead}), for {self._paid(chosen)} instead of "
            f"{self._paid(best)}: that lead is noise, so the cheaper one wins.",
        )

    def _sharper(self, number: int) -> bool:
        if self.sharpness is None or self.reference is None:
            return False
        return self.leads.verdict(self.sharpness, number, self.reference) == "better"

    def _has(self, number: int, metric: str) -> bool:
        return metric in self.estimates[number] and bool(self.leads.found[number].scenes.get(metric))

    def _price(self, number: int) -> float:
        return self.estimates[number][self.cost["field"]].mean

    def _paid(self, number: int) -> str:
        unit = self.cost["unit"] or self.cost["name"]
        return f"{self._price(number):.3g} {unit}"

    def _against(self, metric: str, number: int) -> str | None:
        if self.reference is None or number == self.reference:
            return None
        found = self.leads(metric, number, self.reference)
        return None if found is None else f"{_signed(found, metric)} against {self._name()}"

    def _name(self) -> str:
        return self.names[self.reference] if self.reference is not None else ""

    def _label(self, metric: str) -> str:
        return METRICS[metric].label


def _signed(estimate: Estimate | None, metric: str) -> str:
    if estimate is None:
        return "–"
    own = METRICS[metric]
    text = [f"{value:+.{own.digits}f}".replace("-", "−") for value in estimate if value is not None]
    ends = f" [{text[1]}, {text[2]}]" if len(text) == 3 else ""
    return f"{text[0]}{f' {own.unit}' if own.unit else ''}{ends}"
