"""Silent failures: broken scenes of which nobody is told."""

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig

from nerfdiff.results.frame import Run
from nerfdiff.results.text import markdown_lines
from nerfdiff.stability.breaking import Failure, Rules
from nerfdiff.stability.study import Study, seed_of
from nerfdiff.stability.text import number_text, severity_text

COLUMNS = ("axis", "severity", "strategy", "seed", "scene", "rules", "loss", "harm", "clean_harm")
"""Columns of `silent.csv`. The last three are in dB: how far a scene lies under its own clean result, under `none` with
the same stress, and under `none` without any."""


@dataclass(frozen=True)
class Silent:
    """A silent failure, with the run that left it."""

    stress: DictConfig
    severity: float
    strategy: str
    failure: Failure
    run: Run | None

    @property
    def words(self) -> str:
        """Return the name of the axis, and the severity in its unit."""
        return f"{self.stress.name} {severity_text(self.stress, self.severity)}"

    @property
    def worst(self) -> float:
        """Return its greater loss in dB: against its own clean result, or against `none`."""
        return max(value for value in (self.failure.loss, self.failure.harm, -100.0) if value is not None)

    def harmed_by_stress(self, rules: Rules) -> bool:
        """Return true if the stress puts it as far under `none` as rule c says, beyond where it lies without stress."""
        harm, clean = self.failure.harm, self.failure.clean_harm
        return harm is not None and harm - max(0.0, clean or 0.0) >= rules.harm

    def line(self) -> dict[str, object]:
        """Return its line of `silent.csv`."""
        failure = self.failure
        values = {name: getattr(failure, name) for name in COLUMNS[3:]}
        return {"axis": self.stress.axis, "severity": self.severity, "strategy": self.strategy, **values}


def silent_failures(study: Study) -> list[Silent]:
    """List the silent failures of a study."""
    found = []
    for verdict in study.verdicts:
        for point, runs in zip(verdict.points, verdict.runs, strict=True):
            by_seed = {seed_of(run): run for run in runs}
            stress = study.axes[verdict.axis]
            found += [
                Silent(stress, point.severity, verdict.strategy, failure, by_seed.get(failure.seed))
                for failure in point.silent
            ]
    return found


def worst_of_each(found: Sequence[Silent]) -> list[Silent]:
    """Return one failure for each axis and severity: the one that lost most."""
    worst: dict[tuple[str, float], Silent] = {}
    for each in found:
        key = each.stress.axis, each.severity
        if key not in worst or each.worst > worst[key].worst:
            worst[key] = each
    return list(worst.values())


def silent_markdown(found: Sequence[Silent], rules: Rules) -> str:
    """Count silent failures by rule, and list them by axis and severity."""
    lost = [each for each in found if "b" in each.failure.rules]
    alone = [each for each in found if each.failure.rules == "c"]
    by_stress = sum(each.harmed_by_stress(rules) for each in alone)
    said = (
        f"{len(lost)} scenes by rule (b), {len(alone)} by rule (c) alone. Of the latter, {by_stress} lie "
        f"{rules.harm:g} dB further under `none` than without stress; the others lie there without stress as well. "
        "`silent.csv` lists all, `silent.png` shows the worst of each axis and severity."
    )
    rows = [["axis and severity", "scenes", "of rule (b)", "strategies", "the worst", "loss, dB", "under none, dB"]]
    for worst in worst_of_each(found):
        own = [each for each in found if (each.stress.axis, each.severity) == (worst.stress.axis, worst.severity)]
        failure = worst.failure
        rows.append(
            [
                *(worst.words, str(len(own)), str(sum("b" in each.failure.rules for each in own))),
                ", ".join(sorted({each.strategy for each in own})),
                f"{worst.strategy}, {failure.scene}, seed {failure.seed} ({failure.rules})",
                *(number_text(failure.loss), number_text(failure.harm)),
            ]
        )
    return f"{said}\n\n{markdown_lines(rows)}"
