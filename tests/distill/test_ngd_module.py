"""Test-time fine-tuning on a tiny model: its limits, its failures, and what it leaves alone."""

import dataclasses

import pytest
import torch

from model_fixtures import input_cameras, look_at, model
from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.sampler import SamplerSettings
from nerfdiff.distill.direct import DirectTeacher
from nerfdiff.distill.distillation import Distillation
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.ngd import Guidance, NGDTeacher
from nerfdiff.distill.sds import SDSTeacher
from nerfdiff.distill.stochastic import StochasticTeacher
from nerfdiff.fit.objective import Objective
from nerfdiff.utils.errors import ConfigError


def scene(name: str = "a") -> ViewBatch:
    noise = torch.Generator().manual_seed(3)
    source = input_cameras(1)
    pixels = torch.randint(0, 256, (1, 3, 16, 16), generator=noise, dtype=torch.uint8)
    targets = Cameras(look_at((0.5, 0.2, 0.4))[None, None], source.K[:, None], 16, 16)
    return ViewBatch(
        draws=torch.tensor([0]),
        source_pixels=pixels,
        source_cameras=source,
        target_pixels=pixels[:, None],
        target_cameras=targets,
        near=torch.tensor([0.8]),
        far=torch.tensor([1.8]),
        scene_ids=(name,),
        source_views=("0",),
        target_views=(("1",),),
    )


def prior(views: int):
    places = [(0.9, -0.4, 0.7), (-0.8, 0.3, 1.0), (0.2, 0.6, 2.4)][:views]

    def cameras(scene: ViewBatch) -> Cameras:
        c2w = torch.stack([look_at(place) for place in places])[None]
        return Cameras(c2w, scene.source_cameras.K[:, None].expand(1, views, 3, 3), 16, 16)

    return cameras


def sampling(sampler="ddim", eta=0.0) -> SamplerSettings:
    return SamplerSettings(1.0, 0.0, "uniform_t", sampler, eta)


def guided(gamma=0.3, schedule="snr", condition="first", sampler="ddim", eta=0.0, compare="current", at="fit"):
    guidance = Guidance(schedule, gamma, compare)
    return lambda views: NGDTeacher(views, 4, sampling(sampler, eta), guidance, condition, at)


TEACHERS = {
    "ngd": guided(),
    "ngd, current": guided(condition="current"),
    "ngd, ancestral": guided(eta=1.0),
    "ngd, DPM-Solver++": guided(sampler="dpmpp_2m"),
    "direct": lambda views: DirectTeacher(views, 4, 3, sampling()),
    "direct, DPM-Solver++": lambda views: DirectTeacher(views, 4, 3, sampling("dpmpp_2m")),
    "sds": lambda views: SDSTeacher(views, 4, 1.0, 0.02, "first"),
    "stochastic": lambda views: StochasticTeacher(views, 4, 3, sampling()),
    "stochastic, DPM-Solver++": lambda views: StochasticTeacher(views, 4, 3, sampling("dpmpp_2m")),
}


def distillation(teacher, views=3, inner_steps=3, rays=64, lr_planes=1e-2, **more) -> Distillation:
    options = {
        "lr_decoder": 1e-4,
        "lr_decay": "none",
        "fit_source": False,
        "target_tolerance": 1.0,
        "source_tolerance": 10.0,
        "coarse": "every_step",
        "cuda_graphs": True,
        "views_at_once": 2,
    } | more
    fitted = {"inner_steps": inner_steps, "rays": rays, "lr_planes": lr_planes}
    return Distillation("test", prior(views), teacher, **fitted, **options)


@pytest.mark.parametrize("teacher", TEACHERS)
def test_every_teacher_fits_the_field_and_leaves_the_model_alone(teacher):
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    net.denoiser.unet.conv_out.bias.fill_(2.0)  # an opinion: darker than rendered, so that there is something to fit
    before = {name: value.clone() for name, value in net.state_dict().items()}
    module = distillation(TEACHERS[teacher]).distil(net, [scene()], seed=0)
    assert module.statuses == ["ok"] and len(module.trace(0)) == 4
    assert all(torch.equal(before[name], value) for name, value in net.state_dict().items())
    assert not any(parameter.requires_grad for parameter in net.parameters())
    with torch.no_grad():
        start = net.encode(scene()).triplane.planes
    assert not torch.allclose(module.field.planes, start)
    again = distillation(TEACHERS[teacher]).distil(net, [scene()], seed=0)
    assert torch.equal(again.field.planes, module.field.planes)
    other = distillation(TEACHERS[teacher]).distil(net, [scene()], seed=1)
    assert not torch.equal(other.field.planes, module.field.planes)


@pytest.mark.parametrize(
    ("teacher", "fit_source", "coarse"),
    [(name, name.startswith("ngd"), "every_step") for name in TEACHERS] + [("ngd", True, "refresh")],
)
def test_a_scene_does_not_depend_on_its_company(teacher, fit_source, coarse):
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    method = distillation(
        TEACHERS[teacher], lr_decay="linear", fit_source=fit_source, coarse=coarse, lr_planes=1e-3, lr_decoder=1e-3
    )
    scenes = [scene("a"), scene("b")]
    together = method.distil(net, scenes, seed=0)
    for number, own in enumerate(scenes):
        alone, field = method.distil(net, [own], seed=0), together.field.alone(number)
        torch.testing.assert_close(field.planes, alone.field.planes, atol=1e-4, rtol=1e-4)
        for name, value in alone.field.decoder.state_dict().items():
            torch.testing.assert_close(field.decoder.state_dict()[name], value, atol=1e-4, rtol=1e-4)
        assert together.views[number].field_queries == alone.views[0].field_queries
        for step, expected in zip(together.trace(number), alone.trace(0), strict=True):
            for name, value in dataclasses.asdict(expected).items():
                assert getattr(step, name) == (value if value is None else pytest.approx(value, rel=1e-3))


SHARP = {
    "objective": Objective(8, "l1", 0.1, 0.01),
    "average": 0.5,
    "views_last": 2,
    "fit_source": True,
    "coarse": "refresh",
}


@pytest.mark.parametrize("teacher", ["ngd, current", "direct", "sds, fresh"])
def test_with_all_parts_a_scene_does_not_depend_on_its_company(teacher):
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    fresh = lambda views: SDSTeacher(views, 1, 1.0, 0.02, "first", "sigma2", 1)  # noqa: E731
    method = distillation((TEACHERS | {"sds, fresh": fresh})[teacher], inner_steps=2, lr_planes=1e-3, **SHARP)
    together = method.distil(net, [scene("a"), scene("b")], seed=0)
    for number, own in enumerate((scene("a"), scene("b"))):
        alone, field = method.distil(net, [own], seed=0), together.field.alone(number)
        torch.testing.assert_close(field.planes, alone.field.planes, atol=1e-4, rtol=1e-4)
        assert together.views[number].field_queries == alone.views[0].field_queries
        assert together.views[number].denoiser_calls == alone.views[0].denoiser_calls
        assert together.statuses[number] == alone.statuses[0]


def test_networks_of_the_loss_are_no_part_of_what_is_fitted_saved_or_averaged(monkeypatch):
    net = model().requires_grad_(False)
    plain, sharp = (distillation(TEACHERS["ngd"], inner_steps=1, **options) for options in ({}, SHARP))
    fitted = []
    configure = NGDModule.configure_optimizers

    def noted(self):
        made = configure(self)
        fitted.append([value.shape for group in made.param_groups for value in group["params"]])
        return made

    monkeypatch.setattr(NGDModule, "configure_optimizers", noted)
    before, after = (method.distil(net, [scene()], 0) for method in (plain, sharp))
    assert fitted[0] == fitted[1]
    for module in (after, after.field):
        assert not any("net" in name for name, _ in module.named_modules())
    assert {n: v.shape for n, v in before.state_dict().items()} == {n: v.shape for n, v in after.state_dict().items()}
    assert after._average.snapshot().keys() == dict(after.field.named_parameters()).keys()


@pytest.mark.parametrize(("share", "averaged"), [(0.25, 1), (0.5, 2), (1.0, 4)])
def test_what_is_kept_is_the_mean_over_the_last_share_of_the_steps(share, averaged, monkeypatch):
    seen, keep = [], NGDModule._keep_finite

    def noted(self, losses, targets):
        keep(self, losses, targets)
        seen.append(self.field.snapshot())

    monkeypatch.setattr(NGDModule, "_keep_finite", noted)
    method = distillation(TEACHERS["ngd"], inner_steps=1, lr_planes=1e-3, average=share)
    module = method.distil(model().requires_grad_(False), [scene()], seed=0)
    assert module.statuses == ["ok"] and len(seen) == 4
    for name, value in module.field.named_parameters():
        torch.testing.assert_close(value, torch.stack([one[name] for one in seen[-averaged:]]).mean(0))


def test_settings_of_the_fit_that_cannot_be_are_refused():
    for options, message in (({"average": 1.5}, "strategy.average=1.5"), ({"views_last": 0}, "strategy.views_last=0")):
        with pytest.raises(ConfigError, match=message):
            distillation(TEACHERS["ngd"], **options)


def test_no_virtual_views_are_refused():
    none = dataclasses.replace(distillation(TEACHERS["ngd"]), prior=lambda s: prior(1)(s)[:, :0])
    with pytest.raises(ConfigError, match=r"no virtual views: set budget\.views"):
        none.distil(model().requires_grad_(False), [scene()], seed=0)


def test_scenes_that_do_not_fit_into_one_batch_are_refused():
    net = model().requires_grad_(False)
    views = {"a": 2, "b": 3}
    method = dataclasses.replace(distillation(TEACHERS["direct"]), prior=lambda s: prior(views[s.scene_ids[0]])(s))
    with pytest.raises(ConfigError, match=r"\[2, 3\] virtual views.*scenes_at_once=1"):
        method.distil(net, [scene("a"), scene("b")], seed=0)


@pytest.mark.parametrize("teacher", [guided(condition="last"), lambda v: SDSTeacher(v, 4, 1.0, 0.02, "last")])
def test_an_unknown_condition_is_refused_with_the_known_ones(teacher):
    with pytest.raises(ConfigError, match="choose first or current"):
        distillation(teacher).distil(model().requires_grad_(False), [scene()], seed=0)


@pytest.mark.parametrize("teacher", [DirectTeacher, StochasticTeacher])
def test_a_deterministic_sampler_refuses_noise(teacher):
    noisy = [guided(sampler="dpmpp_2m", eta=1.0), lambda v: teacher(v, 4, 3, sampling("dpmpp_2m", 1.0))]
    for made in noisy:
        with pytest.raises(ConfigError, match="eta=0, got eta=1"):
            distillation(made).distil(model().requires_grad_(False), [scene()], seed=0)


@pytest.mark.parametrize(("decay", "factors"), [("none", [1, 1, 1, 1]), ("linear", [1, 0.75, 0.5, 0.25])])
def test_learning_rates_fall_with_the_steps(decay, factors, monkeypatch):
    rates = []
    fit = NGDModule._fit

    def watched(self, targets):
        rates.append([float(group["lr"]) for group in self.optimizers().param_groups])
        return fit(self, targets)

    monkeypatch.setattr(NGDModule, "_fit", watched)
    distillation(TEACHERS["ngd"], lr_decay=decay).distil(model().requires_grad_(False), [scene()], seed=0)
    assert rates == [pytest.approx([1e-2 * factor, 1e-4 * factor]) for factor in factors]


def test_an_unknown_decay_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="none, linear, cosine"):
        distillation(TEACHERS["ngd"], lr_decay="slow").distil(model().requires_grad_(False), [scene()], seed=0)


def test_the_input_image_is_fitted_where_asked():
    """Views that ask for nothing (full guidance) leave the input image alone to be fitted."""
    net = model().requires_grad_(False)

    def error(fit_source):
        module = distillation(guided(1.0, "constant"), inner_steps=60, fit_source=fit_source).distil(net, [scene()], 0)
        with torch.no_grad():
            image = module.field.render(net.renderer, module.field.cameras[None]).images[0, 0]
        return float((image - scene().source[0]).square().mean())

    assert error(True) < 0.8 * error(False)


def test_full_guidance_asks_for_what_is_rendered_already():
    net = model().requires_grad_(False)
    module = distillation(guided(1.0, "constant")).distil(net, [scene()], seed=0)
    assert all(step.agreement == pytest.approx(60, abs=0.1) for step in module.trace(0))


def distilled(at, fit=(), **teacher):
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    net.denoiser.unet.conv_out.bias.fill_(2.0)
    return distillation(guided(at=at, **teacher), **dict(fit)).distil(net, [scene("a"), scene("b")], seed=0)


@pytest.mark.parametrize(
    "teacher", [{"eta": 1.0}, {"sampler": "dpmpp_2m", "condition": "current"}, {"schedule": "linear", "gamma": 2}]
)
def test_the_denoiser_is_not_asked_where_renderings_take_its_images_place(teacher):
    """At t = 1 and 0.75 of 1, 0.75, 0.5, 0.25; with 2t at 0.5 too."""
    everything, fit = (distilled(at, **teacher) for at in ("everything", "fit"))
    assert torch.equal(everything.field.planes, fit.field.planes)
    assert [everything.trace(scene) for scene in (0, 1)] == [fit.trace(scene) for scene in (0, 1)]
    assert everything.views[0].field_queries == fit.views[0].field_queries
    assert [m.views[1].denoiser_calls for m in (everything, fit)] == [12, 3 if "gamma" in teacher else 6]


@pytest.mark.parametrize("fit", [{}, {"fit_source": True, "coarse": "refresh", "lr_decay": "linear"}])
def test_a_field_is_not_fitted_to_its_own_renderings(fit):
    """The step that follows sees what it would have seen: noise, rates and the field as it began."""
    module = distilled("nothing", fit)
    skipped, last = module.trace(0)[:2], module.trace(0)[2]
    assert [step.weight for step in skipped] == [1, 1] and 0 < last.weight < 1
    assert all(step.loss_first is step.loss_last is None and step.agreement == pytest.approx(60) for step in skipped)
    assert last.loss_first > 0 and module.statuses == ["ok", "ok"] and module.views[0].denoiser_calls == 6
    frozen = distilled("fit", {**fit, "lr_planes": 0.0, "lr_decoder": 0.0})
    assert frozen.trace(0)[2].agreement == last.agreement  # of the same images, drawn towards the same field
    # at its beginning, twice where weights are kept; before the last step; at the end; and the input view
    view = 16 * 16 * module.views[0].model.renderer.samples_per_ray
    fitted = 2 * 3 * 64 * module.views[0].model.renderer.samples_per_ray
    views = 3 + (2 * 4 if "coarse" in fit else 3) + 3 + 2
    assert module.views[0].field_queries == views * view + fitted
    unguided = distilled("nothing", fit, compare="last")
    assert unguided.views[0].denoiser_calls == 12 and unguided.trace(0)[0].loss_first is not None


def test_an_unknown_choice_at_full_guidance_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="at_full_guidance='never': choose everything, fit, nothing"):
        distilled("never")


def test_without_guidance_and_inner_steps_views_are_plain_samples():
    net = model(conditioning={"residual_std": 0.2}).requires_grad_(False)
    module = distillation(guided(0.0), inner_steps=0).distil(net, [scene()], seed=0)
    views = dataclasses.replace(
        distillation(guided(0.0), inner_steps=0), teacher=lambda v: DirectTeacher(v, 1, 4, sampling())
    )
    sampled = views.distil(net, [scene()], seed=0)
    torch.testing.assert_close(module._last_targets, sampled._last_targets)


@pytest.mark.parametrize("gamma", [0.0, 1.0, 1e6])
def test_one_view_and_one_ray_give_numbers(gamma):
    net = model().requires_grad_(False)
    module = distillation(guided(gamma), views=1, rays=1).distil(net, [scene()], seed=0)
    assert bool(module.field.finite()) and module.statuses[0] in ("ok", "diverged")
