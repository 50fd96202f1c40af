"""Which renderer is taken, and that the reference takes over wherever kernels cannot."""

import logging
import sys
from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.nn.functional as F

pytest.importorskip("triton")

from fused_scenes import DEVICE, NAMES, Case, without_trials
from nerfdiff.errors import ConfigError
from nerfdiff.render import backend
from nerfdiff.render.agreement import in_any_order
from nerfdiff.render.kernels import function, passes, tuning
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import KEPT


@pytest.fixture(autouse=True)
def _nothing_told_yet(monkeypatch, caplog):
    for name, value in (("_told", set()), ("_failures", {}), ("_trusted", set())):
        monkeypatch.setattr(backend, name, value)
    without_trials(monkeypatch)
    backend._missing.cache_clear()
    caplog.set_level(logging.WARNING, logger=backend.__name__)
    yield
    backend._missing.cache_clear()


class Scene:
    """A case with its field and rays where the kernels run."""

    def __init__(self, dtype=torch.float32, **sizes):
        self.case = Case(**{"n": 1, "uniform": 2, "importance": 2} | sizes)
        self.leaves = [leaf.to(DEVICE, dtype) for leaf in self.case.leaves]
        self.field, self.rays = self.case.field(self.leaves), self.case.rays(self.leaves)
        self.jitter = self.case.jitter.to(DEVICE, dtype)
        self.reference = self.case.renderer
        self.triton = replace(self.reference, backend="triton")

    def taken_over(self, caplog, why: str, **changes) -> None:
        """The reference's numbers to the bit, and one line that says why, also when asked twice."""
        given = {"field": self.field, "rays": self.rays, "jitter": self.jitter} | changes
        expected = self.reference.render(**given)
        for _ in range(2):
            found = self.triton.render(**given)
            for name in ("rgb", "opacity", "depth"):
                assert torch.equal(getattr(found, name), getattr(expected, name))
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert why in caplog.messages[0]
        assert "reference takes over" in caplog.messages[0]


def test_the_kernels_render_when_asked(caplog):
    scene = Scene()
    found = scene.triton.render(scene.field, scene.rays, scene.jitter)
    expected = scene.case.reference()[0]
    assert (found.rgb.cpu() - expected[0]).abs().max() < 1e-5
    assert (found.depth.cpu() - expected[2]).abs().max() < 1e-5
    assert found.rgb.grad_fn.name().startswith("FusedRender")
    assert not caplog.records


def test_coarse_weights_are_kept_and_given_back(caplog):
    scene, other = Scene(), Scene(shift=1.0)
    kept, expected = (
        r.render(other.field, scene.rays, keep_coarse=True).coarse for r in (scene.triton, scene.reference)
    )
    torch.testing.assert_close(kept, expected, atol=1e-3, rtol=0)
    found, expected = (r.render(scene.field, scene.rays, scene.jitter, kept) for r in (scene.triton, scene.reference))
    torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-4, rtol=0)
    assert found.rgb.grad_fn.name().startswith("FusedRender") and not caplog.records


def test_auto_takes_kernels_on_a_gpu_only(caplog):
    scene = Scene()
    assert scene.reference.backend == "torch" and Renderer(1, 1, 1.0, 1).backend == "auto"
    out = replace(scene.reference, backend="auto").render(scene.field, scene.rays, scene.jitter)
    assert out.rgb.grad_fn.name().startswith("FusedRender") == (DEVICE.type == "cuda")
    assert not caplog.records


@pytest.mark.parametrize("wrong", [{"backend": "cuda"}, {"kernel_precision": "fp8"}])
def test_unknown_choices_are_errors(wrong):
    with pytest.raises(ConfigError, match="choose auto"):
        Renderer(1, 1, 1.0, 1, **wrong)


@pytest.mark.parametrize("gradients", [False, True])
def test_kernels_are_compared_with_the_reference_before_they_are_trusted(gradients, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    looked = []
    real = backend.disagreement
    monkeypatch.setattr(backend, "disagreement", lambda *given: looked.append(given) or real(*given))
    scene = Scene()
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
    scene = Scene(channels=16, hidden=16, plane=(8, 8), scenes=3, own_decoders=True)
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
    scene = Scene(n=8)
    scene.field.triplane.planes.requires_grad_()
    scene.taken_over(caplog, why)


def test_importance_samples_are_missed_in_a_picture_alone(monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    monkeypatch.setattr(backend, "_render", partial(without_importance, backend._render))
    with torch.no_grad():
        Scene(n=8, uniform=6, importance=6).taken_over(caplog, "differ")


@pytest.mark.parametrize("number", range(7), ids=NAMES)
def test_every_wrong_gradient_is_found(number, monkeypatch, caplog):
    monkeypatch.setattr(backend, "_COMPARED", (DEVICE.type,))
    real = function._gradients

    def one_wrong(*given):
        found = real(*given)
        found[number] = -found[number]
        return found

    monkeypatch.setattr(function, "_gradients", one_wrong)
    scene = Scene(n=4)
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
    scene = Scene()
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
    scene = Scene()
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
    scene = Scene()
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
    Scene().taken_over(caplog, "the backward pass failed (RuntimeError: ptxas)")
    assert len(calls) == 1


def test_no_triton(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "nerfdiff.render.kernels.function", None)
    Scene().taken_over(caplog, "triton cannot be imported")


def test_other_fields(caplog):
    scene = Scene()
    scene.taken_over(caplog, "not a triplane", field=lambda points: scene.field(points))


def test_float64(caplog):
    Scene(torch.float64).taken_over(caplog, "torch.float64")


def test_too_wide(caplog):
    Scene(hidden=65).taken_over(caplog, "65 hidden units")


def test_rays_whose_bounds_are_learned(caplog):
    scene = Scene()
    scene.taken_over(caplog, "get no gradients", rays=replace(scene.rays, far=scene.rays.far.requires_grad_()))


def test_no_rays():
    scene = Scene()
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
    Scene().taken_over(caplog, "the forward pass failed (RuntimeError: out of resource: shared memory)")
    assert len(calls) == 1


@pytest.mark.parametrize("coarse", [None, torch.tensor([[[0.1, 0.8]], [[0.5, 0.0]]], dtype=KEPT, device=DEVICE)])
def test_a_backward_pass_that_fails_is_done_by_the_reference(coarse, monkeypatch, caplog):
    def fails(*_, **__):
        raise RuntimeError("ptxas")

    monkeypatch.setattr(function, "gradients", fails)
    scene = Scene(scenes=2, own_decoders=True)
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
    scene = Scene()
    with pytest.raises(torch.OutOfMemoryError):
        scene.triton.render(scene.field, scene.rays, scene.jitter)


def test_products_are_the_reference_s(monkeypatch):
    renderer, gpu = Renderer(1, 1, 1.0, 1), torch.device("cuda", 0)
    monkeypatch.setattr(tuning, "INTERPRETED", False)
    assert backend._precision(renderer, torch.device("cpu")) == "ieee"
    with torch.autocast("cpu", torch.bfloat16):
        assert backend._precision(renderer, torch.device("cpu")) == "bf16"
    assert backend._precision(renderer, gpu) == "tf32x3"
    before = torch.backends.cuda.matmul.fp32_precision
    try:
        torch.backends.cuda.matmul.fp32_precision = "tf32"
        assert backend._precision(renderer, gpu) == "tf32"
    finally:
        torch.backends.cuda.matmul.fp32_precision = before
    assert backend._precision(replace(renderer, kernel_precision="ieee"), gpu) == "ieee"
    monkeypatch.setattr(tuning, "INTERPRETED", True)
    assert backend._precision(replace(renderer, kernel_precision="bf16"), gpu) == "rounded"
