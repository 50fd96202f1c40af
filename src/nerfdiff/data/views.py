"""Datasets over a reader: numbered training draws, and scenes to evaluate."""

from torch.utils.data import Dataset

from nerfdiff.data.batch import Sample
from nerfdiff.data.draws import Draws
from nerfdiff.data.scene import SceneReader
from nerfdiff.errors import DataError


class TrainingViews(Dataset[Sample]):
    """Item n is draw n of the run; any n ≥ 0 is valid.

    Raises:
        DataError: a scene has too few views, or its files are damaged.
    """

    def __init__(self, reader: SceneReader, draws: Draws):
        self.reader, self.draws = reader, draws

    def __getitem__(self, draw: int) -> Sample:
        index = self.draws.scene(draw)
        count = len(self.reader.view_names(index))
        if count <= self.draws.target_views:
            raise DataError(
                f"scene {self.reader.scene_id(index)} has {count} views; a source and "
                f"data.target_views={self.draws.target_views} targets need {self.draws.target_views + 1}"
            )
        source, targets = self.draws.views(draw, count)
        wanted = sorted({source, *targets})
        scene = self.reader.load(index, wanted)
        return Sample(scene, wanted.index(source), [wanted.index(t) for t in targets], draw)


class EvaluationScenes(Dataset[Sample]):
    """Item i is one scene: the given source view, and other views as targets, with ground truth.

    Args:
        reader: the split to evaluate.
        source_view: number of the source view: its name where the views have numbers for names, else its
            position.
        scenes: how many scenes, spread evenly over the split (all where None or more than there are).
        targets: how many targets per scene, spread evenly over the other views (all where None).
        stride: of the other views, take every `stride`-th.

    Raises:
        DataError: a scene has no such source view, or its files are damaged.
    """

    def __init__(
        self,
        reader: SceneReader,
        source_view: int,
        scenes: int | None = None,
        targets: int | None = None,
        stride: int = 1,
    ):
        self.reader, self.source_view = reader, source_view
        self.indices = spread(len(reader), scenes)
        # looked up now, so that a long run does not fail at its first validation
        self.sources = [self._source(index) for index in self.indices]
        self.targets, self.stride = targets, stride

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, item: int) -> Sample:
        index, source = self.indices[item], self.sources[item]
        names = self.reader.view_names(index)
        others = [view for view in range(len(names)) if view != source][:: self.stride]
        if not others:
            raise DataError(f"scene {self.reader.scene_id(index)} has no view beside its source {names[source]}")
        targets = [others[position] for position in spread(len(others), self.targets)]
        scene = self.reader.load(index, [source, *targets], truth=True)
        return Sample(scene, 0, range(1, len(targets) + 1), index)

    def _source(self, index: int) -> int:
        names = self.reader.view_names(index)
        numbered = all(name.isdecimal() for name in names)
        numbers = [int(name) for name in names] if numbered else list(range(len(names)))
        if self.source_view not in numbers:
            raise DataError(
                f"scene {self.reader.scene_id(index)} has no view {self.source_view}, but {len(names)} views "
                f"{names[0]} to {names[-1]}; set data.source_view (or data.val_source_view) to one of them"
            )
        return numbers.index(self.source_view)


def spread(count: int, wanted: int | None) -> list[int]:
    """`wanted` of range(count), the middles of equal parts; all of them where None or too many are wanted."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return [(2 * i + 1) * count // (2 * wanted) for i in range(wanted)]
