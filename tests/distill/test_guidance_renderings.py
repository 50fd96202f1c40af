"""Renderings for the teacher: their coarse weights, their samples, and the input view among them."""

import pytest
import torch
from test_ngd_module import TEACHERS, distillation, scene

from model_fixtures import model
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.settings import COARSE
from nerfdiff.utils.errors import ConfigError


@pytest.mark.parametrize("fit_source", [False, True])
def test_coarse_weights_are_those_of_the_last_refresh(fit_source, monkeypatch):
    """Inner steps are given the weights of the field that guidance rendered, ray by ray, and not of a later one."""
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    renderings, checked = [], []
    render, at = RefinedField.render, RayBatches.coarse_at

    def noted(self, *args, **kwargs):
        renderings.append(render(self, *args, **kwargs))
        return renderings[-1]

    def compared(self, picked):
        given = at(self, picked)
        views = 4 if fit_source else 3
        last = next(r.coarse for r in reversed(renderings) if r.coarse is not None)
        assert last.shape == (1, views, 16, 16, net.renderer.uniform_samples)
        assert torch.equal(given, last.flatten(1, 3)[:, picked[0]])
        checked.append(last)
        return given

    monkeypatch.setattr(RefinedField, "render", noted)
    monkeypatch.setattr(RayBatches, "coarse_at", compared)
    method = distillation(TEACHERS["ngd"], coarse="refresh", fit_source=fit_source, inner_steps=3)
    assert method.distil(net, [scene()], seed=0).statuses == ["ok"]
    assert len(checked) == 4 * 3
    assert not torch.equal(checked[0], checked[-1])


def test_the_input_view_is_rendered_too_where_it_is_fitted():
    net = model().requires_grad_(False)
    queries = {
        (coarse, fit_source): distillation(TEACHERS["ngd"], coarse=coarse, fit_source=fit_source)
        .distil(net, [scene()], 0)
        .views[0]
        .field_queries
        for coarse in COARSE
        for fit_source in (False, True)
    }
    view = 16 * 16 * net.renderer.samples_per_ray
    # what importance sampling needs of the first field's 3 views is not kept, so they are rendered again
    assert queries["refresh", False] == queries["every_step", False] + 3 * view
    assert queries["refresh", True] == queries["every_step", True] + (3 + 4) * view


@pytest.mark.parametrize("teacher", ["direct", "stochastic"])
def test_where_nothing_is_rendered_on_the_way_every_step_computes_its_own_coarse_weights(teacher):
    net = model().requires_grad_(False)
    every, kept = (distillation(TEACHERS[teacher], coarse=c).distil(net, [scene()], seed=0) for c in COARSE)
    assert torch.equal(every.field.planes, kept.field.planes)


def test_an_unknown_choice_of_coarse_weights_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"strategy.coarse='never': choose every_step, refresh"):
        distillation(TEACHERS["ngd"], coarse="never").distil(model().requires_grad_(False), [scene()], seed=0)


def test_renderings_for_the_teacher_have_samples_of_their_own(monkeypatch):
    """And no others: those that decide about a fallback, and inner steps, have the model's."""
    net = model().requires_grad_(False)
    own = net.renderer.uniform_samples, net.renderer.importance_samples
    seen, render = [], RefinedField.render

    def noted(self, renderer, cameras, *args):
        seen.append((renderer.uniform_samples, renderer.importance_samples))
        return render(self, renderer, cameras, *args)

    monkeypatch.setattr(RefinedField, "render", noted)
    view, queries = 16 * 16, {}
    for counts, used in (((None, None), own), ((3, 0), (3, 0)), ((own[0] + 1, 2), (own[0], 2))):
        seen.clear()
        fit = {"guidance_uniform_samples": counts[0], "guidance_importance_samples": counts[1]}
        module = distillation(TEACHERS["ngd"], **fit).distil(net, [scene()], seed=0)
        assert seen == [own] + (4 if counts[0] else 3) * [used] + 2 * [own]  # begun with the virtual views' renderings
        queries[counts] = module.views[0].field_queries
    assert queries[None, None] - queries[3, 0] == 3 * view * (3 * sum(own) - 4 * 3)
    assert distillation(TEACHERS["direct"], **fit).distil(net, [scene()], seed=0).statuses == ["ok"]


def test_kept_coarse_weights_of_fewer_samples_are_split_into_the_renderer_s_bins(monkeypatch):
    net = model().requires_grad_(False)
    given, at = [], RayBatches.coarse_at
    monkeypatch.setattr(RayBatches, "coarse_at", lambda *a: given.append(at(*a)) or given[-1])
    fewer = {"guidance_uniform_samples": 3, "guidance_importance_samples": 2, "coarse": "refresh"}
    assert distillation(TEACHERS["ngd"], **fewer).distil(net, [scene()], seed=0).statuses == ["ok"]
    weights = given[0].unflatten(-1, (3, 2))
    assert torch.equal(weights[..., 0], weights[..., 1]) and 0 < weights.sum((-1, -2)).max() <= 1
    uneven = distillation(TEACHERS["ngd"], coarse="refresh", guidance_uniform_samples=4)
    with pytest.raises(ConfigError, match=r"guidance_uniform_samples=4 bins cannot be .* divisor of 6"):
        uneven.distil(net, [scene()], seed=0)
    for count in ({"guidance_uniform_samples": 0}, {"guidance_importance_samples": -1}):
        with pytest.raises(ConfigError, match=f"strategy.{next(iter(count))}=.* must be at least"):
            distillation(TEACHERS["ngd"], **count)
