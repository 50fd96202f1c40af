"""The choice of a renderer as a process begins with it."""

import logging

import pytest


@pytest.fixture
def fresh_backend(monkeypatch, caplog):
    """Nothing told, failed or trusted yet, and no launch tried out."""
    from fused_scenes import without_trials
    from nerfdiff.render import backend

    for name, value in (("_warned", set()), ("_failures", {}), ("_trusted", set())):
        monkeypatch.setattr(backend, name, value)
    without_trials(monkeypatch)
    backend._missing.cache_clear()
    caplog.set_level(logging.WARNING, logger=backend.__name__)
    yield
    backend._missing.cache_clear()
