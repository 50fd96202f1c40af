"""Reading a sample of a split, and checking it scene by scene."""

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import SceneReader
from nerfdiff.data.views import position_of
from nerfdiff.inspection.all_views import StrayCameras, refuse_missing_files
from nerfdiff.inspection.bounds import scene_distances
from nerfdiff.inspection.check import Check, Finding, Status, check_scene
from nerfdiff.inspection.conventions import explanations
from nerfdiff.inspection.sheet import Row, row_of
from nerfdiff.utils.errors import UserError
from nerfdiff.utils.spread import spread


@dataclass(frozen=True)
class SceneRecord:
    """Findings kept of a scene that was read.

    Args:
        source: position of the input view among the views that were read.
        distances: a sample of how far the scene is from its cameras; `evidence` says what of it.
    """

    id: str
    views: tuple[str, ...]
    cameras: Cameras
    near: float
    far: float
    source: int | None
    mask: bool
    depth: bool
    distances: Float[Tensor, " n"]
    evidence: str
    findings: Mapping[str, Finding]
    row: Row


@dataclass
class SplitSurvey:
    """Findings in one split.

    Args:
        views: views per scene, of all scenes that could be listed.
        strays: what `StrayCameras` found in each of these.
        bad: the error of each scene that could not be listed or read.
        explanations: misreadings that would explain the first failure, None where nothing failed.
    """

    stage: str
    split: str
    scenes: int
    views: list[int] = field(default_factory=list)
    strays: dict[str, Finding] = field(default_factory=dict)
    records: list[SceneRecord] = field(default_factory=list)
    bad: dict[str, str] = field(default_factory=dict)
    explanations: list[str] | None = None


@dataclass(frozen=True)
class Sample:
    """The part of a split that is read.

    Args:
        scenes: how many, at random (None: all).
        views: of each scene, spread evenly (None: all); the input view is one of them.
        distances: how many of each scene's distances from its cameras are kept for the histogram.
        sheet_scenes, sheet_views: how much is kept for the contact sheet.
        seed: of the scenes.
    """

    scenes: int | None
    views: int | None
    distances: int
    sheet_scenes: int
    sheet_views: int
    seed: int


def survey_split(
    stage: str,
    split: str,
    reader: SceneReader,
    source_view: int | None,
    sample: Sample,
    checks: Mapping[str, Check],
    stray_cameras: StrayCameras | None,
    advance: Callable[[], None],
) -> SplitSurvey:
    """List all views of all scenes of a split, read and check some; calls `advance` after each scene of both passes.

    Scenes that a `UserError` keeps from being read are recorded as bad.

    Args:
        source_view: number of the view that every scene must have as its input; None: none is special.
    """
    survey = SplitSurvey(stage, split, len(reader))
    for index in range(len(reader)):
        try:
            survey.views.append(len(reader.view_names(index)))
            if source_view is not None:
                position_of(reader, index, source_view)
            listing = reader.listing(index)
            refuse_missing_files(listing)
            if stray_cameras is not None:
                survey.strays[reader.scene_id(index)] = stray_cameras(listing)
        except UserError as error:
            survey.bad[reader.scene_id(index)] = str(error)
        advance()
    for index in sampled(len(reader), sample.scenes, f"{sample.seed}/{stage}"):
        if reader.scene_id(index) not in survey.bad:
            try:
                survey.records.append(_read(reader, index, source_view, sample, checks, survey))
            except UserError as error:
                survey.bad[reader.scene_id(index)] = str(error)
        advance()
    return survey


def sampled(count: int, wanted: int | None, seed: str) -> list[int]:
    """`wanted` of range(count) at random, ascending; all where None or more."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return sorted(random.Random(seed).sample(range(count), wanted))


def _read(
    reader: SceneReader,
    index: int,
    source_view: int | None,
    sample: Sample,
    checks: Mapping[str, Check],
    survey: SplitSurvey,
) -> SceneRecord:
    views = spread(len(reader.view_names(index)), sample.views)
    source = None if source_view is None else position_of(reader, index, source_view)
    if source is not None:
        views = sorted({*views, source})
    scene = reader.load(index, views, truth=True)
    position = None if source is None else views.index(source)
    findings = check_scene(scene, checks)
    wrong = any(findings[name].status is Status.FAILED for name, check in checks.items() if check.judges_cameras)
    if survey.explanations is None and wrong:
        # a wrong convention is wrong in all scenes, so that one is enough to find out which
        survey.explanations = explanations(scene, checks)
    distances, evidence = scene_distances(scene)
    return SceneRecord(
        scene.id,
        scene.views,
        scene.cameras,
        scene.near,
        scene.far,
        position,
        scene.mask is not None,
        scene.depth is not None,
        distances[:: -(-len(distances) // sample.distances) or 1].clone(),
        evidence,
        findings,
        row_of(scene, position, sample.sheet_views if len(survey.records) < sample.sheet_scenes else 0),
    )
