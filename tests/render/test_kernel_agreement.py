"""Kernels are compared with the reference before they are trusted, in all they give."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.nn.functional as F

pytest.importorskip("triton")

from fused_scenes import DEVICE, NAMES, BackendScene
from nerfdiff.render import backend
from nerfdiff.render.agreement import in_any_order
from nerfdiff.render.kernels import function, passes
from nerfdiff.render.renderer import Renderer

pytestmark = pytest.mark.usefixtures("fresh_backend")


@pytest.mark.parametrize("gradients", [False, True])
def test_kernels_are_compared_with_the_reference_before_they_are_trusted(gradients, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    looked = []
    real = backend.disagreement
    monkeypatch.setattr(backend, "disagreement", lambda *given: looked.append(given) or real(*given))
    scene = BackendScene()
    random = torch.get_rng_state()
    for _ in range(2):
        with torch.set_grad_enabled(gradients):
            found = scene.triton.render(scene.field, scene.rays, scene.jitter)
    assert len(looked) == 1 and not caplog.records
    assert torch.equal(torch.get_rng_state(), random)
    names = {"colours", "opacities", "depths"}
    if gradients:
        names |= set(dict(scene.field.decoder.named_parameters()))
    assert set(looked[0][0]) == set(looked[0][1]) == names
    assert (found.rgb.cpu() - scene.case.reference()[0][0]).abs().max() < 1e-5


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_rounding_is_no_disagreement(dtype, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    scene = BackendScene(channels=16, hidden=16, plane=(8, 8), scenes=3, own_decoders=True)
    with torch.autocast(DEVICE.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
        scene.triton.render(scene.field, scene.rays, scene.jitter)
    assert backend._trusted and not caplog.records


def changed(**changes):
    """Kernels whose colours, opacity or depth are changed."""

    def broken(real, *given):
        outputs = dict(zip(("colours", "opacity", "depth", "kept"), real(*given), strict=True))
        return tuple(changes.get(name, lambda value: value)(value) for name, value in outputs.items())

    return broken


def without_importance(real, renderer, field, rays, jitter, coarse, *more):
    evenly = replace(renderer, uniform_samples=renderer.samples_per_ray, importance_samples=0)
    return real(evenly, field, rays, jitter, None, *more)


WRONG = {
    "colours": (changed(colours=lambda value: value + 0.1), "colours differ"),
    "no numbers": (changed(colours=lambda value: value * torch.nan), "colours differ"),
    "gradients": (changed(colours=lambda value: 2 * value - value.detach()), "gradients of planes differ"),
    "opacity": (changed(opacity=lambda value: 0 * value), "opacities differ"),
    "depth": (changed(depth=lambda value: 7 * value), "depths differ"),
    "samples": (without_importance, "differ"),
}


@pytest.mark.parametrize(("broken", "why"), WRONG.values(), ids=WRONG)
def test_kernels_that_show_something_else_are_not_used(broken, why, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    monkeypatch.setattr(backend, "_render", partial(broken, backend._render))
    scene = BackendScene(n=8)
    scene.field.triplane.planes.requires_grad_()
    scene.taken_over(caplog, why)


def test_importance_samples_are_missed_in_a_picture_alone(monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    monkeypatch.setattr(backend, "_render", partial(without_importance, backend._render))
    with torch.no_grad():
        BackendScene(n=8, uniform=6, importance=6).taken_over(caplog, "differ")


@pytest.mark.parametrize("number", range(7), ids=NAMES)
def test_every_wrong_gradient_is_found(number, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    real = function._gradients

    def one_wrong(*given):
        found = real(*given)
        found[number] = -found[number]
        return found

    monkeypatch.setattr(function, "_gradients", one_wrong)
    scene = BackendScene(n=4)
    for leaf in (scene.field.triplane.planes, scene.rays.origins, scene.rays.directions):
        leaf.requires_grad_()
    names = "planes", "hidden.weight", "hidden.bias", "output.weight", "output.bias", "origins", "directions"
    scene.taken_over(caplog, f"gradients of {names[number]} differ")


@pytest.mark.parametrize("given", ["jitter", "coarse"])
def test_every_way_through_the_kernels_is_compared(given, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    real = backend._render

    def wrong_if_given(renderer, field, rays, jitter, coarse, *more):
        outputs = real(renderer, field, rays, jitter, coarse, *more)
        there = {"jitter": jitter, "coarse": coarse}[given] is not None
        return (outputs[0] + 0.1, *outputs[1:]) if there else outputs

    monkeypatch.setattr(backend, "_render", wrong_if_given)
    scene = BackendScene()
    found = scene.triton.render(scene.field, scene.rays)
    assert found.rgb.grad_fn.name().startswith("FusedRender") and not caplog.records
    more = {"jitter": None, "coarse": torch.rand(1, 1, 2, device=DEVICE)} if given == "coarse" else {}
    scene.taken_over(caplog, "colours differ", **more)


@pytest.fixture(params=[False, True], ids=["errors", "warnings"])
def fixed_order(request):
    """Deterministic algorithms are asked for, and that again afterwards."""
    torch.use_deterministic_algorithms(True, warn_only=request.param)
    yield
    asked = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(False)
    assert asked == (True, request.param)


def test_kernels_keep_a_fixed_order_where_the_reference_has_none(fixed_order, monkeypatch, caplog):
    """On a GPU the backward pass of grid_sample raises then, as it is made to here."""
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    sample, add, added = F.grid_sample, passes.add_cells, []

    def alert(_):
        if torch.are_deterministic_algorithms_enabled():
            raise RuntimeError("grid_sampler_2d_backward_cuda does not have a deterministic implementation")

    def alerting(*given, **more):
        out = sample(*given, **more)
        if out.requires_grad:
            out.register_hook(alert)
        return out

    monkeypatch.setattr(F, "grid_sample", alerting)
    monkeypatch.setattr(passes, "add_cells", lambda *given: added.append(1) or add(*given))
    scene = BackendScene()
    planes = scene.field.triplane.planes.requires_grad_()
    out = scene.triton.render(scene.field, scene.rays, scene.jitter)
    assert out.rgb.grad_fn.name().startswith("FusedRender") and not caplog.records
    assert len(added) == 1  # those that were compared are those that will be used
    (found,) = torch.autograd.grad(out.rgb, planes, scene.case.d_outputs[0].to(DEVICE))
    assert len(added) == 2
    with in_any_order():
        expected = scene.reference.render(scene.field, scene.rays, scene.jitter).rgb
        (truth,) = torch.autograd.grad(expected, planes, scene.case.d_outputs[0].to(DEVICE))
    assert (found - truth).abs().max() <= 1e-4 * truth.abs().max()


def test_errors_of_the_reference_are_not_the_kernels(monkeypatch):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))

    def fails(*_):
        raise RuntimeError("the reference's own")

    monkeypatch.setattr(Renderer, "_render", fails)
    scene = BackendScene()
    with pytest.raises(RuntimeError, match="the reference's own"):
        scene.triton.render(scene.field, scene.rays, scene.jitter)
    assert not backend._failures and not backend._trusted


def test_a_backward_pass_that_fails_when_compared_is_not_tried_again(monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    calls = []

    def fails(*_, **__):
        calls.append(1)
        raise RuntimeError("ptxas")

    monkeypatch.setattr(function, "gradients", fails)
    BackendScene().taken_over(caplog, "the backward pass failed (RuntimeError: ptxas)")
    assert len(calls) == 1
