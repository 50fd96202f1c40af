"""Views that are dropped or drawn for a step, and denoised with an earlier snapshot's help."""

import dataclasses
from itertools import pairwise

import pytest
import torch
from test_ngd_module import distillation, guided, prior, sampling, scene

from model_fixtures import config, model
from nerfdiff.averages import PowerAverages
from nerfdiff.diffusion.deep_features import DeepReuse
from nerfdiff.distill.autoguidance import Autoguidance
from nerfdiff.distill.cdm import CDMSampling
from nerfdiff.distill.direct import DirectTeacher
from nerfdiff.distill.ngd import Guidance, NGDTeacher
from nerfdiff.distill.sds import SDSTeacher
from nerfdiff.distill.virtual_views import VirtualViews, farthest_first
from nerfdiff.exported_model import LoadedModel, export_model
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.utils.errors import CheckpointError, ConfigError


def net(seed: int = 0, **changes):
    made = model(seed, **{"conditioning": {"residual_std": 0.2}} | changes).requires_grad_(False)
    torch.manual_seed(seed + 100)
    made.denoiser.unet.conv_out.weight.normal_(std=0.1)  # an opinion, which depends on what it sees
    return made


def virtual(of, last=None, views=slice(None), at_once=2) -> VirtualViews:
    cameras = prior(3)(scene())[:, views]
    return VirtualViews(of, of.encode(scene()), cameras, at_once, (0,), last)


def noised(count: int):
    draws = torch.Generator().manual_seed(1)
    return torch.randn(count, 3, 16, 16, generator=draws), torch.rand(count, generator=draws)


def test_points_are_ordered_so_that_the_first_are_spread_out():
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    points[7] = points[2]  # twice the same place, which comes last
    order = farthest_first(points).tolist()
    assert sorted(order) == list(range(9)) and order[0] == 0 and {order[-1]} <= {2, 7}
    for count in range(1, 8):
        nearest = {
            i: min(float((points[i] - points[j]).norm()) for j in order[:count])
            for i in range(9)
            if i not in order[:count]
        }
        assert nearest[order[count]] == pytest.approx(max(nearest.values()))


def test_views_fall_evenly_and_do_not_come_back():
    views = virtual(net(), last=1)
    kept = []
    for step in range(5):
        views.choose(step, 5)
        kept.append(views.chosen.tolist())
    assert [len(chosen) for chosen in kept] == [3, 2, 2, 2, 1]
    assert all(set(later) <= set(earlier) and later == sorted(later) for earlier, later in pairwise(kept))
    views = virtual(net(), last=7)
    views.choose(3, 5)
    assert views.chosen is None


@pytest.mark.parametrize("follows", [False, True])
def test_chosen_views_are_denoised_as_if_there_were_no_others(follows):
    of, (z, t) = net(), noised(3)
    rendered = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(2)) if follows else None
    views, alone = virtual(of, last=2), virtual(of, views=[0, 2])
    views.chosen = torch.tensor([0, 2])
    found = views.denoise(z, t, rendered)
    torch.testing.assert_close(
        found[[0, 2]], alone.denoise(z[[0, 2]], t[[0, 2]], rendered[[0, 2]] if follows else None)
    )
    assert found[1].eq(0).all() and views.denoiser_calls == alone.denoiser_calls == 2


@pytest.mark.parametrize(("fit_source", "coarse"), [(False, "every_step"), (True, "refresh")])
def test_what_is_dropped_is_neither_denoised_rendered_nor_fitted(fit_source, coarse):
    of, options = net(), {"coarse": coarse, "fit_source": fit_source, "inner_steps": 1}
    teacher = guided(condition="current", at="everything")
    every = distillation(teacher, **options).distil(of, [scene()], 0)
    module = distillation(teacher, views_last=1, **options).distil(of, [scene()], 0)
    assert every.views[0].denoiser_calls == 4 * 3 and module.views[0].denoiser_calls == 3 + 2 + 2 + 1
    view = 16 * 16 * of.renderer.samples_per_ray
    # three steps, and the rendering at the end
    assert every.views[0].field_queries - module.views[0].field_queries == (4 + 2) * view
    assert module.statuses == ["ok"] and len(module.trace(0)) == 4
    with pytest.raises(ConfigError, match="deep_every=1"):
        virtual(of, last=2).deep_features(DeepReuse(2, 1))


def test_only_rays_of_chosen_views_are_fitted(monkeypatch):
    seen, run = [], InnerSteps.run

    def noted(self, steps):
        losses = run(self, steps)
        seen.append(set((self._picked // 256).flatten().tolist()))
        return losses

    monkeypatch.setattr(InnerSteps, "run", noted)
    module = distillation(guided(), inner_steps=1, views_last=1, fit_source=True).distil(net(), [scene()], 0)
    order = module.views[0]._order.tolist()
    assert seen == [set(order[:count]) | {3} for count in (3, 2, 2, 1)]


def test_keeping_all_views_changes_nothing():
    found = [
        distillation(guided(), inner_steps=1, views_last=last).distil(net(), [scene()], 0).field.planes
        for last in (None, 50)
    ]
    assert torch.equal(found[0], found[1])


def fresh(views_per_step=1, steps=2):
    return lambda views: SDSTeacher(views, steps, 0.98, 0.02, "first", "sigma2", views_per_step)


@pytest.mark.parametrize(("at_once", "gradient_steps"), [(1, 6), (2, 3), (5, 2)])
def test_sds_with_fresh_noise_has_as_many_denoiser_calls_and_one_gradient_step_each(at_once, gradient_steps):
    method = distillation(fresh(at_once), inner_steps=1)
    module = method.distil(net(), [scene()], 0)
    assert len(module.trace(0)) == gradient_steps
    assert module.views[0].denoiser_calls == 2 * 3
    assert torch.equal(method.distil(net(), [scene()], 0).field.planes, module.field.planes)
    if at_once == 1:
        drawn = module.views[0]._table.flatten().tolist()
        assert len(drawn) == 6 and set(drawn) <= {0, 1, 2} and len(set(drawn)) > 1


def test_sds_weighs_views_so_that_gradients_are_dreamfusions():
    """Of L2 on renderings x against x̂0, weighed, each gradient is w(t) (ε̂ − ε) with w = σ², times one number."""
    of = net()
    views = virtual(of)
    teacher = SDSTeacher(views, 1, 0.98, 0.02, "first", "sigma2")
    rendered = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(2))
    noise, times = 0.5 * noised(3)[0], torch.tensor([0.1, 0.5, 0.9])
    views.noise, views.uniform = lambda: noise, lambda: (times - 0.02) / 0.96
    given = {}
    denoise = views.denoise

    def noted(z, t, seen):
        given.update(z=z, t=t, x0=denoise(z, t, seen))
        return given["x0"]

    views.denoise = noted
    targets = teacher.targets(0, rendered)
    x = rendered.clone().requires_grad_()
    (teacher.view_weights * (x - targets).square().flatten(1).sum(1)).sum().backward()
    angle = 0.5 * torch.pi * times[:, None, None, None]
    predicted = (given["z"] - angle.cos() * given["x0"]) / angle.sin()
    torch.testing.assert_close(x.grad, 2 * angle.sin() ** 2 * (predicted - noise), atol=1e-5, rtol=1e-4)
    assert SDSTeacher(views, 1, 0.98, 0.02, "first").view_weights is None


def test_settings_of_sds_that_cannot_be_are_refused():
    for arguments, message in ((("first", "sigma"), "uniform or sigma2"), (("first", "uniform", 0), "at least 1")):
        with pytest.raises(ConfigError, match=message):
            SDSTeacher(virtual(net()), 1, 0.98, 0.02, *arguments)


def snapshot(of, folder) -> str:
    names, values = zip(*((n, v) for n, v in of.named_parameters() if n.startswith("denoiser.")), strict=True)
    averages = PowerAverages([0.1])
    averages.update(list(values), 1)
    averages.save(folder, names, 1)
    return str(folder / "step_0000001_0.1.safetensors")


def exported(of, folder, **changes) -> str:
    config = {"name": "test"} | changes
    export_model(LoadedModel(of, folder, "ema", config, None, {}), folder, torch.float32)
    return str(folder)


def test_autoguidance_leads_away_from_what_the_snapshot_makes(tmp_path):
    strong, weak, (z, t) = net(), net(1), noised(3)
    path = snapshot(weak, tmp_path)
    # the snapshot's weights in the model's own place, with the model's encoder
    plain, other = virtual(strong), net()
    for name, value in other.denoiser.named_parameters():
        value.copy_(dict(weak.denoiser.named_parameters())[name].half())
    first, second = plain.denoise(z, t), virtual(other).denoise(z, t)
    assert float((first - second).abs().max()) > 0.05
    for scale in (1.0, 1.5):
        views = virtual(strong)
        views.autoguide(Autoguidance(path, scale))
        found = views.denoise(z, t)
        assert views.denoiser_calls == 6
        inside = (first.abs() < 1) & (second.abs() < 1)  # both are clamped, and so is what comes out
        expected = (second + scale * (first - second)).clamp(-1, 1)
        torch.testing.assert_close(found[inside], expected[inside], atol=1e-5, rtol=1e-4)
        assert torch.equal(found, first) == (scale == 1)


TEACHERS = {
    "ngd": lambda own: lambda v: NGDTeacher(v, 2, sampling(), Guidance("snr", 0.3, "last"), "current", "fit", own),
    "direct": lambda own: lambda v: DirectTeacher(v, 2, 2, sampling(), own),
}


@pytest.mark.parametrize("teacher", TEACHERS)
def test_of_scale_1_fields_are_the_same_and_cost_twice_the_calls(teacher, tmp_path):
    path = snapshot(net(1), tmp_path)
    none, one, two = (
        distillation(TEACHERS[teacher](own), inner_steps=1).distil(net(), [scene()], 0)
        for own in (None, Autoguidance(path, 1.0), Autoguidance(path, 2.0))
    )
    assert torch.equal(none.field.planes, one.field.planes) and not torch.equal(none.field.planes, two.field.planes)
    assert [module.views[0].denoiser_calls for module in (none, one, two)] == [6, 12, 12]


def test_sampled_views_are_guided_too(tmp_path):
    path = snapshot(net(1), tmp_path)
    none, one, two = (
        CDMSampling("cdm", 2, sampling(), 4, own).predict(net(), [scene()], 0)[0]
        for own in (Autoguidance(), Autoguidance(path, 1.0), Autoguidance(path, 2.0))
    )
    assert torch.equal(none.images, one.images) and not torch.equal(none.images, two.images)
    assert [views.denoiser_calls for views in (none, one, two)] == [2, 4, 4]


def test_a_snapshot_of_another_cdm_is_refused_and_one_that_is_none(tmp_path):
    wide = {"unet": {"width": 64}}
    paths = {
        r"other sizes or conditioning: \d+ weights differ, as unet": snapshot(net(**wide), tmp_path / "wide"),
        "another conditioning.*0.5.* there and .*0.2": exported(
            net(conditioning={"residual_std": 0.5}),
            tmp_path / "std",
            **config(conditioning={"residual_std": 0.5}),
        ),
        "not a readable snapshot": str(tmp_path / "none.safetensors"),
    }
    for message, path in paths.items():
        with pytest.raises(CheckpointError, match=message):
            virtual(net()).autoguide(Autoguidance(path))
    with pytest.raises(ConfigError, match=r"autoguidance\.scale=0\.5 must be at least 1"):
        Autoguidance(None, 0.5)


def test_an_export_guides_and_says_if_its_encoder_is_another(tmp_path, caplog):
    own = config(conditioning={"residual_std": 0.2})
    views, again = virtual(net()), virtual(net())
    views.autoguide(Autoguidance(exported(net(1), tmp_path / "other", **own)))
    assert "has another encoder" in caplog.text
    caplog.clear()
    mine = net()
    mine.denoiser.unet.conv_out.bias.fill_(0.5)
    again.autoguide(Autoguidance(exported(mine, tmp_path / "same", **own)))
    assert not caplog.text
    z, t = noised(3)
    assert not torch.equal(views.denoise(z, t), again.denoise(z, t))


def test_a_snapshot_is_read_once(tmp_path, monkeypatch):
    path, of = snapshot(net(1), tmp_path), net()
    guidance = Autoguidance(path)
    assert guidance.denoiser(of) is guidance.denoiser(of)
    assert dataclasses.replace(guidance) == guidance and guidance.denoiser(net()) is not guidance.denoiser(of)
    assert not any(p.requires_grad for p in guidance.denoiser(of).parameters())
