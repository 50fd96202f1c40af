"""Datasets over a reader: numbered training draws, and scenes to evaluate."""

import logging
from collections.abc import Sequence

from torch.utils.data import Dataset

from nerfdiff.data.batch import Sample
from nerfdiff.data.draws import Draws
from nerfdiff.data.scene import SceneReader
from nerfdiff.utils.errors import DataError, some
from nerfdiff.utils.shard import Shard
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)


class TrainingViews(Dataset[Sample]):
    """Item n is draw n of the run; any n ≥ 0 is valid.

    Args:
        reader: the split to train on.
        draws: over as many scenes as are trained on, spread evenly over the split.
        source_view: number of the view that every draw takes as its source (None: any view).

    Raises:
        DataError: a scene has too few views or no such source view, or its files are damaged.
    """

    def __init__(self, reader: SceneReader, draws: Draws, source_view: int | None = None):
        self.reader, self.draws, self.source_view = reader, draws, source_view
        self.indices = spread(len(reader), draws.scenes)

    def __getitem__(self, draw: int) -> Sample:
        index = self.indices[self.draws.scene(draw)]
        count = len(self.reader.view_names(index))
        if count <= self.draws.target_views:
            raise DataError(
                f"scene {self.reader.scene_id(index)} has {count} views; a source and "
                f"data.target_views={self.draws.target_views} targets need {self.draws.target_views + 1}"
            )
        fixed = None if self.source_view is None else position_of(self.reader, index, self.source_view)
        source, targets = self.draws.views(draw, count, fixed)
        wanted = sorted({source, *targets})
        scene = self.reader.load(index, wanted)
        return Sample(scene, wanted.index(source), [wanted.index(t) for t in targets], draw, self.draws.shift(draw))


class EvaluationScenes(Dataset[Sample]):
    """Item i is one scene: the given source view, and other views as targets, with ground truth.

    Args:
        reader: the split to evaluate.
        source_view: number of the source view, see `view_numbers`; where some scenes lack it and have their nearest
            one instead, a warning says so.
        scenes: how many scenes, spread evenly over the split (all where None or more than there are).
        targets: how many targets per scene, spread evenly over the other views (all where None).
        stride: of the other views, take every `stride`-th.
        shard: of these scenes; None: all of them.

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
        shard: Shard | None = None,
    ):
        self.reader = reader
        self.indices = spread(len(reader), scenes)
        if shard is not None:
            self.indices = shard.share(self.indices)
        # looked up now, so that a long run does not fail at its first validation
        self.sources = [position_of(reader, index, source_view) for index in self.indices]
        self.targets, self.stride = targets, stride
        nearest = []
        for index, source in zip(self.indices, self.sources, strict=True):
            names = reader.view_names(index)
            if view_numbers(names)[source] != source_view:
                nearest.append(f"{reader.scene_id(index)} ({names[source]})")
        if nearest:
            log.warning(
                "%d of %d scenes have no view %d (data.source_view) and the nearest one as their input: %s",
                len(nearest),
                len(self.indices),
                source_view,
                some(nearest),
            )

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


def position_of(reader: SceneReader, index: int, view: int) -> int:
    """Position among a scene's views of view number `view`, or of the nearest where `reader.nearest_view`.

    Raises:
        DataError: there is no such view.
    """
    names = reader.view_names(index)
    numbers = view_numbers(names)
    if reader.nearest_view:
        return min(range(len(numbers)), key=lambda position: (abs(numbers[position] - view), numbers[position]))
    if view not in numbers:
        raise DataError(
            f"scene {reader.scene_id(index)} has no view {view}, but {len(names)} views {names[0]} to {names[-1]}; set "
            "data.source_view (or data.val_source_view, data.train_source_view) to one of them"
        )
    return numbers.index(view)


def view_numbers(names: Sequence[str]) -> list[int]:
    """Each view's number: its name where all names are numbers, else its position."""
    return [int(name) for name in names] if all(name.isdecimal() for name in names) else list(range(len(names)))
