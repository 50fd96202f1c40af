"""The function that a launcher runs in place of the command's."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from omegaconf import DictConfig

from nerfdiff.utils.memory import forget_peak_memory, keep_freed_memory

log = logging.getLogger(__name__)


@dataclass
class Task:
    """A job that does not begin after the sweep's time is up, in whichever process and on whichever machine.

    Args:
        function: the command's.
        until: seconds since the epoch; None is no limit.
    """

    function: Callable[[DictConfig], object]
    until: float | None = None

    @property
    def late(self) -> bool:
        return self.until is not None and time.time() > self.until

    def __call__(self, cfg: DictConfig) -> object:
        if self.late:
            log.info("not begun: the sweep's minutes are spent")
            return None
        keep_freed_memory()  # of the launcher's process: it did not pass through the command
        forget_peak_memory()  # of jobs that it ran before
        return self.function(cfg)
