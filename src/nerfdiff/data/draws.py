"""The order of training: draw n = 0, 1, 2, … of a run is a pure function of the seed and n.

A run resumes by going on at the next draw, and neither workers nor ranks nor gradient accumulation change
which draws make up an optimizer step.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Int64, UInt64
from torch.utils.data import Sampler

SCENE_ORDER, VIEWS, SHIFTS = 0, 1, 2  # streams of random numbers that must not meet


def random_bits(seed: int, stream: int, counter: int, count: int) -> UInt64[np.ndarray, "{count}"]:
    """`count` random uint64 that depend on the three numbers alone (Salmon et al. 2011, Philox)."""
    return np.random.Philox(key=[seed, stream], counter=[0, counter, 0, 0]).random_raw(count)


@lru_cache(maxsize=4)
def scene_order(seed: int, epoch: int, scenes: int) -> Int64[np.ndarray, "{scenes}"]:
    """The shuffled order in which pass `epoch` over the dataset visits its scenes."""
    return np.argsort(random_bits(seed, SCENE_ORDER, epoch, scenes), kind="stable")


@dataclass(frozen=True)
class Draws:
    """The rule that turns a draw's number into a scene, a source view and target views.

    Args:
        seed: of the whole run.
        scenes: number of scenes; every pass visits each of them once.
        target_views: T, target views per draw, all different.
        source_as_target: probability that the first target is the source view itself; apart from that,
            targets are never the source.
        source_target_noise: variance of the noise on the position of such a target's camera, in squared scene units.
        source_views: sources are among so many first views of a scene (None: any view).
    """

    seed: int
    scenes: int
    target_views: int
    source_as_target: float
    source_target_noise: float = 0.0
    source_views: int | None = None

    def scene(self, draw: int) -> int:
        """Index of the draw's scene."""
        epoch, position = divmod(draw, self.scenes)
        return int(scene_order(self.seed, epoch, self.scenes)[position])

    def views(self, draw: int, views: int, source: int | None = None) -> tuple[int, tuple[int, ...]]:
        """Source and target positions among the scene's `views`, which must be more than `target_views`.

        Args:
            source: the source's position, where it is not to be drawn.
        """
        bits = random_bits(self.seed, VIEWS, draw, views + 1)
        order = np.argsort(bits[:views], kind="stable").tolist()
        if source is None:
            source = next(view for view in order if self.source_views is None or view < self.source_views)
        targets = [view for view in order if view != source][: self.target_views]
        if bits[views] < self.source_as_target * 2.0**64:
            targets[0] = source
        return source, tuple(targets)

    def shift(self, draw: int) -> tuple[float, float, float] | None:
        """Draw the shift of the camera of a target that is the source itself; None without noise.

        Seen from exactly where it was taken, an input view is explained by a plane in front of the camera (paper,
        appendix, "Training phase").
        """
        if not self.source_target_noise:
            return None
        bits = np.random.Generator(np.random.Philox(key=[self.seed, SHIFTS], counter=[0, draw, 0, 0]))
        return tuple(bits.normal(0, self.source_target_noise**0.5, 3).tolist())


class DrawSampler(Sampler[list[int]]):
    """One rank's batches of draw numbers: step s takes the `batch_size` draws from s·`batch_size` on.

    Its length is that of the whole run, from step 0, because Lightning counts batches from the run's start;
    it yields those from `start_step` on.

    Args:
        batch_size: draws per optimizer step, over all ranks.
        micro_batch_size: draws per batch of this rank.
        rank, world_size: this process among all.
        start_step, total_steps: optimizer steps already made, and of the whole run.
    """

    def __init__(
        self,
        batch_size: int,
        micro_batch_size: int,
        rank: int,
        world_size: int,
        start_step: int,
        total_steps: int,
    ):
        self.batch_size, self.micro_batch_size = batch_size, micro_batch_size
        self.rank, self.share = rank, batch_size // world_size
        self.start_step, self.total_steps = start_step, total_steps

    def __len__(self) -> int:
        return self.total_steps * (self.share // self.micro_batch_size)

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start_step, self.total_steps):
            first = step * self.batch_size + self.rank * self.share
            for start in range(first, first + self.share, self.micro_batch_size):
                yield list(range(start, start + self.micro_batch_size))
