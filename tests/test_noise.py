import importlib
import logging
import warnings

import lightning
import pytest

from nerfdiff.metrics.perceptual import LPIPS_VGG
from nerfdiff.noise import REPEATED, TALKATIVE, quieten


@pytest.fixture(autouse=True)
def loggers():
    """New ones, and afterwards as they were."""
    named = [logging.getLogger(name) for name in ("lightning", *TALKATIVE, *REPEATED)]
    before = [(one.level, list(one.handlers), list(one.filters)) for one in named]
    for one in named:
        one.setLevel(logging.NOTSET)
        one.handlers, one.filters = [], []
    with warnings.catch_warnings():
        yield
    for one, (level, handlers, filters) in zip(named, before, strict=True):
        one.setLevel(level)
        one.handlers, one.filters = handlers, filters
        vars(one).pop("addHandler", None)


def test_what_keeps_a_metric_empty_is_said_once(caplog, tmp_path):
    for _ in range(3):  # jobs of a sweep
        quieten()
        assert LPIPS_VGG.find(tmp_path / "nowhere") is None
    assert len(caplog.records) == 1 and "lpips is left empty" in caplog.text
    LPIPS_VGG.find(tmp_path / "elsewhere")
    assert len(caplog.records) == 2


def test_processes_that_share_the_work_leave_it_to_the_first(caplog, tmp_path, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "1")
    quieten()
    LPIPS_VGG.find(tmp_path)
    assert not caplog.records


@pytest.mark.parametrize(("level", "news"), [(logging.INFO, []), (logging.DEBUG, ["advertisement"])])
def test_libraries_say_what_matters_unless_all_is_asked_for(level, news, caplog):
    with caplog.at_level(level):
        quieten()
        for name in TALKATIVE:
            logging.getLogger(name).info("advertisement")
            logging.getLogger(name).warning("a fault")
    assert [record.message for record in caplog.records] == [*news, "a fault"] * len(TALKATIVE)


def test_deprecations_are_for_their_authors(recwarn):
    quieten()
    for category in (DeprecationWarning, FutureWarning, UserWarning):
        warnings.warn("a word", category, stacklevel=1)
    assert [warning.category for warning in recwarn] == [UserWarning]


def test_lightnings_lines_come_once(caplog):
    caplog.set_level(logging.INFO)
    quieten()
    importlib.reload(lightning)  # which adds a handler of its own whenever it is imported
    lightning.Trainer(logger=False, accelerator="cpu", devices=1)  # would advertise another logger
    logging.getLogger("lightning.pytorch.trainer").warning("a line")
    assert not logging.getLogger("lightning").handlers
    assert [record.message for record in caplog.records] == ["a line"]
