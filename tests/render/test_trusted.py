"""Comparisons that are kept between processes, and what makes them worth nothing."""

import json
from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton")

from fused_scenes import DEVICE, BackendScene
from nerfdiff.render import backend, trusted

pytestmark = pytest.mark.usefixtures("fresh_backend")


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Where it is kept; the reference stands in for the kernels."""

    def kernels(renderer, field, rays, jitter, coarse, *_):
        out = replace(renderer, backend="torch").render(field, rays, jitter, coarse)
        return out.rgb, out.opacity, out.depth, None

    path = tmp_path / "cache" / "trusted.json"
    monkeypatch.setenv(trusted.VARIABLE, str(path))
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    monkeypatch.setattr(backend, "_render", kernels)
    return path


@pytest.fixture
def compared(monkeypatch):
    """How often kernels were compared."""
    calls, real = [], backend.disagreement
    monkeypatch.setattr(backend, "disagreement", lambda *given: calls.append(1) or real(*given))
    return calls


def render(gradients=False, **sizes):
    """What a process would render that begins now."""
    backend._trusted.clear()
    backend._failures.clear()
    scene = BackendScene(n=4, **sizes)
    with torch.set_grad_enabled(gradients):
        return scene.triton.render(scene.field, scene.rays, scene.jitter)


def test_what_agreed_is_compared_once_for_all_processes(file, compared, caplog):
    first, second = render(), render()
    assert len(compared) == 1 and torch.equal(first.rgb, second.rgb) and not caplog.records
    for count, other in enumerate(({"hidden": 32}, {"gradients": True}, {"uniform": 7}), 2):
        render(**other)
        render(**other)
        assert len(compared) == count, other


@pytest.mark.parametrize("what", ["_triton", "_sources"])
def test_other_kernels_are_compared_anew(what, file, compared, monkeypatch):
    render()
    monkeypatch.setattr(trusted, what, lambda: "other")
    render()
    assert len(compared) == 2 and len(json.loads(file.read_text())) == 2


def test_what_disagreed_is_not_kept(file, compared, monkeypatch, caplog):
    real = backend._render
    monkeypatch.setattr(backend, "_render", lambda *given: (real(*given)[0] + 0.1, *real(*given)[1:]))
    render()
    assert len(compared) == 1 and not file.exists() and "colours differ" in caplog.text


@pytest.mark.parametrize("content", ["{", "[]", '{"a": 1}', '{"a": [1]}', "\\xff"])
def test_a_damaged_file_is_ignored_with_a_line_and_mended(content, file, compared, caplog):
    file.parent.mkdir()
    file.write_bytes(content.encode("latin1"))
    render()
    assert len(compared) == 1 and f"{file} is ignored" in caplog.text
    render()
    assert len(compared) == 1


def test_a_file_that_cannot_be_written_ends_nothing(file, compared, caplog):
    file.mkdir(parents=True)  # a folder where the file would be
    render()
    render()
    assert len(compared) == 2 and "compares kernels with the reference again" in caplog.text


def test_an_empty_variable_keeps_nothing(file, compared, monkeypatch):
    monkeypatch.setenv(trusted.VARIABLE, "")
    render()
    render()
    assert len(compared) == 2 and not file.parent.exists()
    monkeypatch.delenv(trusted.VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(file.parent))
    render()
    render()
    assert len(compared) == 3 and (file.parent / "nerfdiff" / "trusted_kernels.json").is_file()
