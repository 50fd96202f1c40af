"""Which renderer is taken, and that the reference takes over wherever kernels cannot."""

import sys
from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton")

from fused_scenes import DEVICE, BackendScene
from nerfdiff.render import backend
from nerfdiff.render.kernels import function, tuning
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import KEPT
from nerfdiff.utils.errors import ConfigError

pytestmark = pytest.mark.usefixtures("fresh_backend")


def test_the_kernels_render_when_asked(caplog):
    scene = BackendScene()
    found = scene.triton.render(scene.field, scene.rays, scene.jitter)
    expected = scene.case.reference()[0]
    assert (found.rgb.cpu() - expected[0]).abs().max() < 1e-5
    assert (found.depth.cpu() - expected[2]).abs().max() < 1e-5
    assert found.rgb.grad_fn.name().startswith("FusedRender")
    assert not caplog.records


def test_coarse_weights_are_kept_and_given_back(caplog):
    scene, other = BackendScene(), BackendScene(shift=1.0)
    kept, expected = (
        r.render(other.field, scene.rays, keep_coarse=True).coarse for r in (scene.triton, scene.reference)
    )
    torch.testing.assert_close(kept, expected, atol=1e-3, rtol=0)
    found, expected = (r.render(scene.field, scene.rays, scene.jitter, kept) for r in (scene.triton, scene.reference))
    torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-4, rtol=0)
    assert found.rgb.grad_fn.name().startswith("FusedRender") and not caplog.records


def test_auto_takes_kernels_on_a_gpu_only(caplog):
    scene = BackendScene()
    assert scene.reference.backend == "torch" and Renderer(1, 1, 1.0, 1).backend == "auto"
    out = replace(scene.reference, backend="auto").render(scene.field, scene.rays, scene.jitter)
    assert out.rgb.grad_fn.name().startswith("FusedRender") == (DEVICE.type == "cuda")
    assert not caplog.records


@pytest.mark.parametrize("wrong", [{"backend": "cuda"}, {"kernel_precision": "fp8"}, {"skip": "much"}])
def test_unknown_choices_are_errors(wrong):
    with pytest.raises(ConfigError, match=r"choose (auto|none)"):
        Renderer(1, 1, 1.0, 1, **wrong)


def test_no_triton(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "nerfdiff.render.kernels.function", None)
    BackendScene().taken_over(caplog, "triton cannot be imported")


def test_other_fields(caplog):
    scene = BackendScene()
    scene.taken_over(caplog, "not a triplane", field=lambda *given: scene.field(*given))


def test_float64(caplog):
    BackendScene(torch.float64).taken_over(caplog, "torch.float64")


def test_too_wide(caplog):
    BackendScene(hidden=65).taken_over(caplog, "65 hidden units")


def test_rays_whose_bounds_are_learned(caplog):
    scene = BackendScene()
    scene.taken_over(caplog, "get no gradients", rays=replace(scene.rays, far=scene.rays.far.requires_grad_()))


def test_no_rays():
    scene = BackendScene()
    none = replace(scene.rays, **{name: getattr(scene.rays, name)[:, :0] for name in vars(scene.rays)})
    assert "nothing to render" in backend._obstacle(scene.triton, scene.field, none, None, None)


def test_old_gpus_and_other_devices(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (7, 5))
    assert "compute capability 7.5" in backend._device_obstacle(torch.device("cuda", 0))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    assert backend._device_obstacle(torch.device("cuda", 0)) is None
    assert "mps" in backend._device_obstacle(torch.device("mps"))
    monkeypatch.setattr(tuning, "INTERPRETED", False)
    assert "interpreter" in backend._device_obstacle(torch.device("cpu"))


def test_a_kernel_that_fails_is_not_tried_again(monkeypatch, caplog):
    calls = []

    def fails(*_):
        calls.append(1)
        raise RuntimeError("out of resource: shared memory\nRequired: 300000")

    monkeypatch.setattr(function, "render", fails)
    BackendScene().taken_over(caplog, "the forward pass failed (RuntimeError: out of resource: shared memory)")
    assert len(calls) == 1


@pytest.mark.parametrize("coarse", [None, torch.tensor([[[0.1, 0.8]], [[0.5, 0.0]]], dtype=KEPT, device=DEVICE)])
def test_a_backward_pass_that_fails_is_done_by_the_reference(coarse, monkeypatch, caplog):
    def fails(*_, **__):
        raise RuntimeError("ptxas")

    monkeypatch.setattr(function, "gradients", fails)
    scene = BackendScene(scenes=2, own_decoders=True)
    planes = scene.field.triplane.planes.requires_grad_()
    wanted = [planes, *scene.field.decoder.parameters()]
    colours = scene.case.d_outputs[0].to(DEVICE)
    found, expected = (
        torch.autograd.grad(renderer.render(scene.field, scene.rays, scene.jitter, coarse).rgb, wanted, colours)
        for renderer in (scene.triton, scene.reference)
    )
    for value, truth in zip(found, expected, strict=True):
        assert (value - truth).abs().max() <= 1e-4 * truth.abs().max()
    out = scene.triton.render(scene.field, scene.rays, scene.jitter)
    assert not out.rgb.grad_fn.name().startswith("FusedRender")
    assert len(caplog.records) == 1 and "the backward pass failed (RuntimeError: ptxas)" in caplog.messages[0]


def test_memory_that_runs_out_is_not_hidden(monkeypatch):
    def fails(*_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(function, "render", fails)
    scene = BackendScene()
    with pytest.raises(torch.OutOfMemoryError):
        scene.triton.render(scene.field, scene.rays, scene.jitter)


def test_halves_are_taken_where_the_reference_takes_them():
    renderer, cpu = Renderer(1, 1, 1.0, 1), torch.device("cpu")
    assert not backend._half(renderer, cpu)
    with torch.autocast("cpu", torch.bfloat16):
        assert backend._half(renderer, cpu)
        assert not backend._half(replace(renderer, kernel_precision="ieee"), cpu)
    assert backend._half(replace(renderer, kernel_precision="bf16"), cpu)


@pytest.mark.parametrize("wrong", [-0.1, 1.0, float("nan")])
def test_what_must_get_through_is_a_share(wrong):
    with pytest.raises(ConfigError, match="least_transmittance"):
        Renderer(1, 1, 1.0, 1, least_transmittance=wrong)
