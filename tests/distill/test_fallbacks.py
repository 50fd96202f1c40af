"""Scenes that fail on the way, or are made worse: what they fall back to, and their company."""

import dataclasses

import pytest
import torch
from test_ngd_module import TEACHERS, distillation, sampling, scene

from model_fixtures import model
from nerfdiff.distill.ngd import Guidance, NGDTeacher


class Failing:
    """The same images until a step, and from there on what is no image."""

    t = weight = view_weights = gap = None
    follows_field, steps = False, 6

    def __init__(self, images, at, value=float("nan")):
        self.images, self.at, self.value, self.asked = images, at, value, 0

    def targets(self, step, rendered):
        self.asked += 1
        images = self.images.clone()
        if step >= self.at:
            images[-1, :, 0, 0] = self.value  # one pixel, which rays may miss
        return images


def starting_planes(net):
    with torch.no_grad():
        return net.encode(scene()).triplane.planes


def test_a_scene_that_fails_leaves_the_others_alone():
    net = model().requires_grad_(False)

    def ruined(views):
        teacher = TEACHERS["direct"](views)
        if views.seed[-1] == "b":
            teacher.images = teacher.images * float("nan")
        return teacher

    module = distillation(ruined).distil(net, [scene("a"), scene("b")], seed=0)
    alone = distillation(TEACHERS["direct"]).distil(net, [scene("a")], seed=0)
    assert module.statuses == ["ok", "non-finite"] and bool(module.field.finite().all())
    torch.testing.assert_close(module.field.planes[:1], alone.field.planes)
    start = net.encode(scene()).triplane.planes
    assert torch.equal(module.field.planes[1:], start)  # it failed at once: what was good is where it began


def test_a_field_that_blows_up_falls_back_to_the_last_finite_one():
    net = model().requires_grad_(False)

    class Poisoned(NGDTeacher):
        def targets(self, step, rendered):
            images = super().targets(step, rendered)
            return images * float("nan") if step == 2 else images

    poisoned = distillation(lambda v: Poisoned(v, 4, sampling(), Guidance("snr", 0.3, "current"), "first"))
    module = poisoned.distil(net, [scene()], seed=0)
    assert module.statuses == ["non-finite"] and bool(module.field.finite())
    assert not torch.equal(module.field.planes, starting_planes(net)), "two steps that did no harm are kept"


@pytest.mark.parametrize("tolerance", [0.1, 60.0])
@pytest.mark.parametrize("at", [4, 99])
def test_what_was_finite_before_it_failed_must_stand_the_same_test(tolerance, at):
    """A teacher of random images ruins a field, whether it ends in numbers or not."""
    net = model().requires_grad_(False)
    noise = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(0)).round()
    white = dataclasses.replace(scene(), source_pixels=torch.full_like(scene().source_pixels, 255))
    method = distillation(lambda v: Failing(noise, at), lr_planes=0.1, inner_steps=20, source_tolerance=tolerance)
    module = method.distil(net, [white], seed=0)
    assert module.statuses == ["non-finite" if at == 4 else "diverged" if tolerance < 1 else "ok"]
    with torch.no_grad():
        start = net.encode(white).triplane.planes
    assert torch.equal(module.field.planes, start) == (tolerance < 1)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("at", [0, 3])
def test_a_lost_scene_stops_computing_and_its_company_goes_on(at, value):
    net = model().requires_grad_(False)
    made = {}

    def teacher(views):
        made[views.seed[-1]] = Failing(views.first_renderings * 0.9, at if views.seed[-1] == "b" else 99, value)
        return made[views.seed[-1]]

    alone = distillation(teacher, rays=4).distil(net, [scene("b")], seed=0)
    assert alone.statuses == ["non-finite"] and bool(alone.field.finite())
    assert made["b"].asked == at + 1 == len(alone.trace(0))
    assert torch.equal(alone.field.planes, starting_planes(net)) == (at == 0)
    own = distillation(teacher, rays=4).distil(net, [scene("a")], seed=0)
    both = distillation(teacher, rays=4).distil(net, [scene("b"), scene("a")], seed=0)
    assert both.statuses == ["non-finite", "ok"] and (made["a"].asked, made["b"].asked) == (6, at + 1)
    torch.testing.assert_close(both.field.planes[1:], own.field.planes)
    torch.testing.assert_close(both.field.planes[:1], alone.field.planes)


@pytest.mark.parametrize(("tolerance", "status"), [(0.0, "diverged"), (60.0, "ok")])
def test_how_much_worse_is_worse_is_a_choice(tolerance, status):
    net = model().requires_grad_(False)
    method = distillation(TEACHERS["direct"], lr_planes=1e4, target_tolerance=tolerance, source_tolerance=60.0)
    assert method.distil(net, [scene()], seed=0).statuses == [status]


def test_a_field_made_worse_falls_back_to_where_it_began():
    net = model().requires_grad_(False)
    module = distillation(TEACHERS["direct"], lr_planes=1e4).distil(net, [scene()], seed=0)
    with torch.no_grad():
        start = net.encode(scene()).triplane.planes
    assert module.statuses == ["diverged"] and torch.equal(module.field.planes, start)
