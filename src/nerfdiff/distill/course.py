"""How far a distillation is on its schedule, how far its next step goes, and what a deadline leaves of both."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from nerfdiff.utils.errors import ConfigError

SCHEDULE, AGREEMENT, DEADLINE = "schedule", "agreement", "deadline"
"""Why a distillation ended: it did all that its budget has; or less, as field and CDM agreed no better, or for want of
time."""
REHEARSED = 2
"""Views, steps and inner steps of the small distillation that measures the pace; its first step warms up."""


class Course:
    """A place on a schedule of so many steps, from 0 to `steps`. A step may be longer than 1, and end in between.

    Diffusion times, learning rates and numbers of views depend on the place, not on how many steps were taken. So fewer
    steps still run to the schedule's end.

    Args:
        steps: length of the schedule.
        planned: steps to be taken, of which none is shorter than 1; None: as many as it is long.
    """

    def __init__(self, steps: int, planned: int | None = None):
        self.steps, self.position, self.until, self.taken = steps, 0.0, 0.0, 0
        self.planned = self._most = planned or steps
        self.stopped_by = SCHEDULE

    def begin_step(self, affordable: int | None = None) -> bool:
        """Choose where the next step ends (`until`); return false where there is none.

        Args:
            affordable: steps for which there is time; None: there is no deadline.
        """
        left = self.steps - self.position
        steps = max(min(math.ceil(left), self._most - self.taken), int(left > 0))
        if affordable is not None and affordable < steps:
            self.stopped_by, steps = DEADLINE, affordable
        if steps < 1:
            return False
        self.until = float(self.steps) if steps == 1 else self.position + max(1.0, left / steps)
        return True

    def end_step(self, is_enough: bool = False) -> None:
        """Go to where the step ends.

        Args:
            is_enough: what is left of the schedule shall be one step.
        """
        self.position, self.taken = self.until, self.taken + 1
        if is_enough and self._most > self.taken + 1:
            self.stopped_by, self._most = AGREEMENT, self.taken + 1


class Plateau:
    """Tells when a value rises no longer.

    Args:
        patience: so many last values in which the best before them was not exceeded by `rise`.
    """

    def __init__(self, patience: int, rise: float):
        self.patience, self.rise = patience, rise
        self._values: list[float] = []

    def __call__(self, value: float) -> bool:
        """Take in one more value."""
        self._values.append(value)
        before, last = self._values[: -self.patience], self._values[-self.patience :]
        return bool(before) and max(last) < max(before) + self.rise


@dataclass
class Pace:
    """Seconds of the pieces of one scene's distillation, as last measured; NaN where nothing was yet.

    Args:
        begin: of a virtual view before the first step.
        ask: of a virtual view in each step: its rendering for the teacher, and its denoising.
        fit: of an inner step.
        end: of a virtual view after the last step: the check that the field became no worse.
        steps: of a whole schedule.
    """

    begin: float = math.nan
    ask: float = math.nan
    fit: float = math.nan
    end: float = math.nan
    steps: int = 0

    def step(self, views: int, inner_steps: int) -> float:
        """Return the seconds of a step."""
        return views * self.ask + inner_steps * self.fit


@dataclass(frozen=True)
class Deadline:
    """When the field of a scene has to be there.

    Args:
        seconds: from its input image to its field; None: no matter when.
        clock: that says the time in seconds.

    Raises:
        ConfigError: there is no time at all.
    """

    seconds: float | None = None
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self):
        if self.seconds is not None and not self.seconds > 0:
            raise ConfigError(f"seconds_per_scene={self.seconds} must be more than 0, or null")

    def begin(self, *args) -> "Timekeeper | None":
        """Begin to count, see `Timekeeper`; None where there is no deadline."""
        return None if self.seconds is None else Timekeeper(self, *args)


class Timekeeper:
    """Says how much can be done until the deadline, from what it measured. Each measurement waits for the device.

    Args:
        deadline: from now on.
        pace: which is measured anew, and stays for the next scene.
        scenes: that are distilled together.
        device: that does the work.
        rehearsal: do but little, to measure the pace.
    """

    def __init__(self, deadline: Deadline, pace: Pace, scenes: int, device: torch.device, rehearsal: bool = False):
        self.pace, self.rehearsal, self._clock, self._device = pace, rehearsal, deadline.clock, device
        self._scenes, self._until = scenes, self._now() + scenes * deadline.seconds
        self.shortened = False

    def _now(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return self._clock()

    @contextmanager
    def measure(self, piece: str, count: int) -> Iterator[None]:
        """Measure `count` pieces of one kind, for each scene."""
        start = self._now()
        yield
        if count:
            setattr(self.pace, piece, (self._now() - start) / (count * self._scenes))

    def plan(self, views: int, inner_steps: int) -> tuple[int, int]:
        """Return how many views and inner steps there shall be, so that enough steps fit into the time that is left.

        What is too much is taken in equal shares from the number of steps and from what each of them does. How many
        there are is planned as they come, see `affordable`. Of the time at most half goes into what comes before and
        after them.
        """
        if self.rehearsal:
            return min(views, REHEARSED), min(inner_steps, REHEARSED)
        left = max(0.0, (self._until - self._now()) / self._scenes)
        ends = views * (self.pace.begin + self.pace.end)
        full = ends + self.pace.steps * self.pace.step(views, inner_steps)
        share = min(1.0, math.sqrt(left / full), left / (2 * ends)) if full > left else 1.0
        planned = max(1, round(share * views)), min(inner_steps, max(1, round(share * inner_steps)))
        self.shortened = planned != (views, inner_steps)
        return planned

    def affordable(self, taken: int, views: int, inner_steps: int) -> int:
        """Return for how many more steps there is time.

        Args:
            taken: steps that were taken already.
        """
        if self.rehearsal:
            return REHEARSED - taken
        left = (self._until - self._now()) / self._scenes - views * self.pace.end
        step = self.pace.step(views, inner_steps)
        return max(0, int(left / step)) if step > 0 else 10**9
