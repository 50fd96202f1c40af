"""Filters for messages of libraries and repeated jobs that do not matter to a person."""

import logging
import os
import sys
import warnings

TALKATIVE = (
    "lightning.pytorch.utilities.rank_zero",  # GPU available, TPU available, an advertisement, max_steps reached
    "lightning.fabric.utilities.rank_zero",
    "matplotlib.font_manager",
)
REPEATED = ("nerfdiff.metrics.weights", "nerfdiff.metrics.sets")
"""Loggers that would say the same in every job of a sweep and every process."""


class Once(logging.Filter):
    """Lets each message pass once in a process, and none in those that share the work of the first."""

    def __init__(self):
        super().__init__()
        self.said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        new = record.getMessage() not in self.said and os.environ.get("LOCAL_RANK", "0") == "0"
        self.said.add(record.getMessage())
        return new


def quieten() -> None:
    """Keep warnings and errors of libraries and no news (`hydra.verbose=true` keeps these), and say nothing twice.

    Deprecations are for the libraries' authors, unless Python's -W asks for them.
    """
    lightning = logging.getLogger("lightning")
    lightning.handlers.clear()
    lightning.addHandler = lambda handler: None  # it adds one when imported, beside the program's own
    for name in TALKATIVE if logging.getLogger().level > logging.DEBUG else ():
        logger = logging.getLogger(name)
        if logger.level == logging.NOTSET:
            logger.setLevel(logging.WARNING)
    for name in REPEATED:
        logger = logging.getLogger(name)
        if not any(isinstance(one, Once) for one in logger.filters):
            logger.addFilter(Once())
    if not sys.warnoptions:
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        warnings.filterwarnings("ignore", "The number of training batches")  # is smaller than the logging interval
