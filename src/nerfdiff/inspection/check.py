"""Findings of checks: of one scene, and of a split's scenes together."""

import statistics
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from nerfdiff.data.scene import Scene


class Status(StrEnum):
    OK = "ok"
    FAILED = "failed"
    UNCHECKED = "not checked"


@dataclass(frozen=True)
class Finding:
    """One check of one scene: its measurement, and why it failed or could not be made."""

    status: Status
    value: float | None = None
    reason: str = ""

    @staticmethod
    def judged(value: float, reason: str | None) -> "Finding":
        """Failed for a reason, or ok where there is none."""
        return Finding(Status.OK if reason is None else Status.FAILED, value, reason or "")

    @staticmethod
    def unchecked(reason: str) -> "Finding":
        return Finding(Status.UNCHECKED, reason=reason)


@runtime_checkable
class Measure(Protocol):
    """A check whose findings are judged together.

    `measures` says what their values are; `higher_is_better` how to read them; `tolerated` is the share of scenes that
    may fail before the split does.
    """

    measures: str
    higher_is_better: bool
    tolerated: float


@runtime_checkable
class Check(Measure, Protocol):
    """A property that every scene should have.

    `judges_cameras` says whether wrong cameras are what makes it fail; `matches_images` whether it compares cameras
    with what the images show, and then `tells_focal` whether it notices a wrong focal length; `fallback` checks are
    made only where no other with `matches_images` could be.
    """

    judges_cameras: bool
    matches_images: bool
    tells_focal: bool
    fallback: bool

    def __call__(self, scene: Scene) -> Finding: ...


def check_scene(scene: Scene, checks: Mapping[str, Check]) -> dict[str, Finding]:
    """All findings; checks that are a fallback only say something where no other compares cameras and images."""
    findings: dict[str, Finding] = {}
    compared = False
    for name, check in sorted(checks.items(), key=lambda item: item[1].fallback):
        if check.fallback and compared:
            findings[name] = Finding.unchecked("not needed: cameras and images are compared otherwise")
            continue
        findings[name] = check(scene)
        compared |= check.matches_images and findings[name].status is not Status.UNCHECKED
    return findings


@dataclass(frozen=True)
class Verdict:
    """One check of one split.

    Args:
        suspects: why each scene that failed did.
    """

    check: str
    status: Status
    text: str
    median: float | None
    worst: float | None
    scenes: int
    suspects: Mapping[str, str]


def verdict(name: str, check: Measure, findings: Mapping[str, Finding]) -> Verdict:
    """Judge the findings of a split's scenes, given by scene id."""
    made = {scene: finding for scene, finding in findings.items() if finding.status is not Status.UNCHECKED}
    if not made:
        reasons = Counter(finding.reason for finding in findings.values())
        text = reasons.most_common(1)[0][0] if reasons else "no scene could be read"
        return Verdict(name, Status.UNCHECKED, text, None, None, 0, {})
    suspects = {scene: finding.reason for scene, finding in made.items() if finding.status is Status.FAILED}
    values = {scene: finding.value for scene, finding in made.items()}
    worst = (min if check.higher_is_better else max)(values, key=values.get)
    median = statistics.median(values.values())
    text = f"{check.measures}: {median:.3g}"
    if len(made) > 1:
        text = f"{check.measures}: median {median:.3g}, worst {values[worst]:.3g} ({worst})"
    status = Status.FAILED if len(suspects) > check.tolerated * len(made) else Status.OK
    if suspects and status is Status.OK:
        text += f"; {len(suspects)} of {len(made)} scenes suspect"
    elif suspects:
        # the reason of the worst of them stands for the others, all of which the report lists
        shown = worst if worst in suspects else next(iter(suspects))
        text = f"{len(suspects)} of {len(made)} scenes: {suspects[shown]}"
    return Verdict(name, status, text, median, values[worst], len(made), suspects)
