"""Renderings for the teacher that leave empty pixels as they were."""

from dataclasses import replace

import pytest
import torch
from test_ngd_module import distillation, guided, scene
from test_virtual_views import net as exact_net

from nerfdiff.distill.module import NGDModule
from nerfdiff.utils.errors import ConfigError

TEACHER = guided(1.0, "linear", condition="current")


def net(skip="faint"):
    made = exact_net()
    made.renderer = replace(made.renderer, skip=skip)
    return made


@pytest.fixture
def seen(monkeypatch):
    """Record each rendering for the teacher: what was seen before, what it shows, and a rendering of all pixels."""
    calls = []
    plain = NGDModule._render_again

    def watched(self, renderer):
        before = self._seen
        with torch.no_grad():
            whole = self.field.render(renderer, self.cameras)
        calls.append((before, plain(self, renderer).clone(), whole))
        return self._seen[0]

    monkeypatch.setattr(NGDModule, "_render_again", watched)
    return calls


def neighbourhood(opacity, below, reach):
    """Tell by a plain loop which pixels [views, height, width] have one that is not empty within reach."""
    found = torch.zeros_like(opacity, dtype=torch.bool)
    for view, row, column in (opacity >= below).nonzero().tolist():
        found[view, max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = True
    return found


@pytest.mark.parametrize("reach", [0, 1])
def test_pixels_are_rendered_where_one_nearby_is_not_empty_and_else_keep_their_colours(seen, reach):
    model = net()
    middle = float(distilled_opacity(model).median())
    distillation(TEACHER, empty_below=middle, empty_reach=reach, whole_every=3, lr_planes=0.3).distil(
        model, [scene()], 0
    )
    assert len(seen) == 3 and seen[0][0] is None
    torch.testing.assert_close(seen[0][1], seen[0][2].images)
    for before, images, whole in seen[1:]:
        near = neighbourhood(before[1][0], middle, reach)
        assert near.any() and not near.all()
        expected = torch.where(near[:, None], whole.images[0], before[0][0])
        torch.testing.assert_close(images[0], expected, atol=1e-5, rtol=0)
        assert (whole.images[0] - before[0][0]).abs().max() > 1e-3  # the field has moved


def distilled_opacity(model):
    field = distillation(TEACHER).distil(model, [scene()], 0)
    with torch.no_grad():
        return field.field.render(model.renderer, field.cameras).opacity


def test_all_pixels_come_again_every_so_many_renderings(seen):
    distillation(TEACHER, empty_below=0.99, empty_reach=0, whole_every=2, lr_planes=0.3).distil(net(), [scene()], 0)
    assert torch.equal(seen[2][1], seen[2][2].images)


def test_where_nothing_is_empty_the_field_is_that_of_whole_renderings():
    whole = distillation(TEACHER).distil(net(), [scene()], 0)
    some = distillation(TEACHER, empty_below=1e-12).distil(net(), [scene()], 0)
    torch.testing.assert_close(some.field.planes, whole.field.planes, atol=1e-4, rtol=0)
    assert some.views[0].field_queries == whole.views[0].field_queries


def test_a_scene_does_not_depend_on_its_company_and_fewer_points_are_asked_for():
    options = {"empty_below": float(distilled_opacity(net()).median()), "empty_reach": 0, "whole_every": 8}
    whole = distillation(TEACHER).distil(net(), [scene()], 0)
    alone = distillation(TEACHER, **options).distil(net(), [scene()], 0)
    both = distillation(TEACHER, **options).distil(net(), [scene(), scene("b")], 0)
    torch.testing.assert_close(both.field.planes[:1], alone.field.planes, atol=1e-4, rtol=0)
    assert alone.views[0].field_queries < whole.views[0].field_queries


@pytest.mark.parametrize(
    "wrong", [{"empty_below": 1.0}, {"empty_below": -0.1}, {"empty_reach": -1}, {"whole_every": 0}]
)
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        distillation(TEACHER, **wrong)
