"""A split in numbers."""

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from nerfdiff.inspection.all_views import StrayCameras
from nerfdiff.inspection.camera_checks import field_of_view
from nerfdiff.inspection.check import Check, Status, Verdict, verdict
from nerfdiff.inspection.survey import SceneRecord, SplitSurvey


@dataclass(frozen=True)
class Range:
    """Extremes and median; equal where there is only one value."""

    low: float
    median: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> "Range | None":
        return Range(min(values), statistics.median(values), max(values)) if values else None

    def __str__(self) -> str:
        if self.low == self.high:
            return f"{self.low:.4g}"
        return f"{self.low:.4g} – {self.high:.4g} (median {self.median:.4g})"


@dataclass(frozen=True)
class SplitSummary:
    """The report's facts on one split.

    Args:
        stage: "train", "val" or "test"; `split` is the dataset's name for it.
        absent: why there is nothing to say, where the split is missing; `error`: where it cannot be read.
        views: per scene, of all scenes; the rest is of the scenes that were read.
        sizes: "height x width" to how many scenes.
        focal: in pixels, along x; `fov` in degrees across the larger side.
        masks, depths: how many of the scenes read have them.
        compared: for how many of the scenes read some check could compare cameras with images.
        focal_told: whether one of those checks notices a wrong focal length.
        allow_unchecked: whether the split may pass where none was compared.
    """

    stage: str
    split: str
    absent: str | None = None
    error: str | None = None
    scenes: int = 0
    views: Range | None = None
    scenes_read: int = 0
    images_read: int = 0
    sizes: dict[str, int] = field(default_factory=dict)
    focal: Range | None = None
    fov: Range | None = None
    near: Range | None = None
    far: Range | None = None
    masks: int = 0
    depths: int = 0
    checks: tuple[Verdict, ...] = ()
    compared: int = 0
    focal_told: bool = False
    allow_unchecked: bool = False
    bad: dict[str, str] = field(default_factory=dict)
    explanations: list[str] | None = None
    pictures: dict[str, str] = field(default_factory=dict)

    @property
    def failures(self) -> list[str]:
        """List the split's faults, in a few words each."""
        failed = [f"{check.check} failed" for check in self.checks if check.status is Status.FAILED]
        bad = [f"{len(self.bad)} bad scene{'s' if len(self.bad) > 1 else ''}"] if self.bad else []
        unchecked = self.scenes_read and not self.compared and not self.allow_unchecked
        return ([self.error] if self.error else []) + failed + bad + (["cameras unchecked"] if unchecked else [])

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def summarise_split(
    survey: SplitSurvey,
    checks: Mapping[str, Check],
    strays: StrayCameras | None,
    pictures: Mapping[str, str],
    allow_unchecked: bool,
) -> SplitSummary:
    records: list[SceneRecord] = survey.records
    findings = {name: {record.id: record.findings[name] for record in records} for name in checks}
    verdicts = [verdict(name, check, findings[name]) for name, check in checks.items()]
    if strays is not None:
        verdicts.insert(0, verdict("stray_cameras", strays, survey.strays))
    comparing = [
        {name for name, found in record.findings.items() if checks[name].matches_images and found.value is not None}
        for record in records
    ]
    return SplitSummary(
        stage=survey.stage,
        split=survey.split,
        scenes=survey.scenes,
        views=Range.of(survey.views),
        scenes_read=len(records),
        images_read=sum(len(record.views) for record in records),
        sizes=dict(Counter(f"{r.cameras.height} x {r.cameras.width}" for r in records)),
        focal=Range.of([f for r in records for f in r.cameras.K[:, 0, 0].tolist()]),
        fov=Range.of([angle for r in records for angle in field_of_view(r.cameras).tolist()]),
        near=Range.of([r.near for r in records]),
        far=Range.of([r.far for r in records]),
        masks=sum(r.mask for r in records),
        depths=sum(r.depth for r in records),
        checks=tuple(verdicts),
        compared=sum(map(bool, comparing)),
        focal_told=any(checks[name].tells_focal for names in comparing for name in names),
        allow_unchecked=allow_unchecked,
        bad=dict(survey.bad),
        explanations=survey.explanations,
        pictures=dict(pictures),
    )
