import pytest
import torch

from model_fixtures import config, input_cameras, look_at, model
from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.denoiser import cast_products, gaussian_velocity
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, v_from_x0_eps
from nerfdiff.utils.errors import ConfigError

HALF = torch.full((2,), 0.5)  # t of two views
VARIANTS = {
    "rendered": {"image": "rendered", "ray_maps": False, "cross_attention": True, "residual_std": None},
    "preconditioned": {"image": "rendered", "ray_maps": False, "cross_attention": True, "residual_std": 0.2},
    "concat": {"image": "source", "ray_maps": True, "cross_attention": False, "residual_std": None},
    "cross_attention": {"image": "none", "ray_maps": True, "cross_attention": True, "residual_std": None},
}


def build(variant: str):
    net = model(conditioning={"name": variant, **VARIANTS[variant]})
    for parameter in net.denoiser.parameters():
        if parameter.abs().sum() == 0:
            torch.nn.init.normal_(parameter, std=0.1)
    return net


def views() -> Cameras:
    source = input_cameras(1)
    c2w = torch.stack([torch.eye(4), look_at((0.9, -0.4, 0.7))])[None]
    return Cameras(c2w, source.K[None].expand(1, 2, 3, 3), 16, 16)


def condition_of(net, source):
    bounds = torch.tensor([0.8]), torch.tensor([1.8])
    encoding = net.encode_images(source, input_cameras(1), *bounds)
    return net.condition(encoding, views(), net.render(encoding, views()).images)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_sees_the_input_image_and_the_wanted_view(variant):
    net, noise = build(variant), torch.Generator().manual_seed(0)
    source, other = torch.rand(2, 1, 3, 16, 16, generator=noise)
    z = torch.randn(1, 3, 16, 16, generator=noise).expand(2, -1, -1, -1)
    x0 = net.denoiser(z, HALF, condition_of(net, source))
    assert not torch.allclose(x0[0], x0[1], atol=1e-5), "two views, one noise: only the camera differs"
    changed = net.denoiser(z, HALF, condition_of(net, other))
    assert not torch.allclose(x0, changed, atol=1e-5)


@pytest.mark.parametrize("variant", ["preconditioned", "concat"])
def test_weights_cast_once_denoise_as_those_that_autocast_casts_at_each_call(variant):
    net = build(variant).requires_grad_(False).to(memory_format=torch.channels_last)
    names, z = list(net.state_dict()), torch.randn(2, 3, 16, 16)
    with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
        condition = condition_of(net, torch.rand(1, 3, 16, 16))
        each_call = net.denoiser(z, HALF, condition)
        cast_products(net.denoiser, torch.bfloat16)
        assert torch.equal(net.denoiser(z, HALF, condition), each_call)
    assert list(net.state_dict()) == names
    types = {type(layer): layer.weight.dtype for layer in net.denoiser.modules() if hasattr(layer, "weight")}
    assert types == {
        torch.nn.Conv2d: torch.bfloat16,
        torch.nn.Linear: torch.bfloat16,
        torch.nn.GroupNorm: torch.float32,
    }
    assert {p.dtype for part in (net.encoder, net.decoder) for p in part.parameters()} == {torch.float32}


def test_a_denoised_image_is_alpha_z_minus_sigma_v():
    net = build("rendered")
    condition = condition_of(net, torch.rand(1, 3, 16, 16))
    z, t = torch.randn(2, 3, 16, 16), torch.tensor([0.5, 1.0])
    v = net.denoiser.velocity(z, t, condition)
    x0 = net.denoiser(z, t, condition)
    torch.testing.assert_close(x0[0], 0.5**0.5 * (z[0] - v[0]))
    torch.testing.assert_close(x0[1], -v[1])


def test_an_untrained_preconditioned_cdm_believes_the_rendering_where_all_is_noise():
    net = model(conditioning={"residual_std": 0.2})  # its last layer is zero
    condition = condition_of(net, torch.rand(1, 3, 16, 16))
    z = torch.randn(2, 3, 16, 16)
    rendered = 2 * condition.rendered - 1
    torch.testing.assert_close(net.denoiser(z, torch.ones(2), condition), rendered)
    # and in between it is the posterior mean, in the form of a Kalman gain
    alpha = sigma = 0.5**0.5
    gain = 0.04 * alpha / (0.04 * alpha**2 + sigma**2)
    expected = rendered + gain * (z - alpha * rendered)
    torch.testing.assert_close(net.denoiser(z, HALF, condition), expected)


def test_only_a_rendered_condition_can_be_built_upon():
    with pytest.raises(ConfigError, match=r"residual_std=0\.2 needs conditioning\.image=rendered"):
        model(conditioning={"image": "source", "ray_maps": True, "residual_std": 0.2})


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_settled_encoding_conditions_as_the_encoding_itself(variant):
    net = build(variant)
    source, near, far = torch.rand(2, 3, 16, 16), torch.full((2,), 0.8), torch.full((2,), 1.8)
    with torch.no_grad():
        encoding = net.encode_images(source, input_cameras(2), near, far)
        wanted = Cameras(views().c2w.expand(2, 2, 4, 4), views().K.expand(2, 2, 3, 3), 16, 16)
        rendering, z = net.render(encoding, wanted), torch.randn(4, 3, 16, 16)
        plain, settled = (
            net.denoiser(z, torch.full((4,), 0.5), net.condition(known, wanted, rendering.images))
            for known in (encoding, net.with_keys_values(encoding))
        )
    torch.testing.assert_close(settled, plain, atol=1e-4, rtol=1e-4)


def test_the_denoising_loss_flows_back_through_the_rendering():
    net = build("rendered")
    condition = condition_of(net, torch.rand(1, 3, 16, 16))
    net.denoiser.velocity(torch.randn(2, 3, 16, 16), torch.rand(2), condition).square().sum().backward()
    assert net.decoder.hidden.weight.grad.abs().sum() > 0
    assert net.encoder.unet.conv_in.weight.grad.abs().sum() > 0


def test_a_cdm_that_cannot_know_the_view_is_refused():
    with pytest.raises(ConfigError, match="ray_maps=true"):
        model(conditioning={"image": "source", "ray_maps": False})


def test_unknown_images_are_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="rendered, source, none"):
        model(conditioning={"image": "depth"})


def test_the_fixture_is_the_rendered_variant():
    assert {k: v for k, v in config()["conditioning"].items() if k != "name"} == VARIANTS["rendered"]


@pytest.mark.parametrize("t", [0.05, 0.3, 0.7, 0.95])
def test_against_regression_on_samples(t):
    """v regressed on Z over many draws is the closed form, and what the regression leaves has its deviation."""
    noise = torch.Generator().manual_seed(0)
    mean, std = 0.4, 0.25
    alpha, sigma = alpha_sigma(torch.tensor(t, dtype=torch.float64))
    x0 = mean + std * torch.randn(400_000, generator=noise, dtype=torch.float64)
    eps = torch.randn(400_000, generator=noise, dtype=torch.float64)
    z, v = add_noise(x0, eps, alpha, sigma), v_from_x0_eps(x0, eps, alpha, sigma)
    predicted, deviation = gaussian_velocity(z, torch.full_like(z, mean), std, alpha, sigma)
    design = torch.stack([torch.ones_like(z), z], 1)
    fitted = design @ torch.linalg.lstsq(design, v[:, None]).solution
    torch.testing.assert_close(predicted, fitted[:, 0], atol=5e-3, rtol=0)
    assert float((v - predicted).std()) == pytest.approx(float(deviation), rel=5e-3)


def test_both_ends_are_finite():
    """At t = 1 the best guess is the mean itself; at t = 0, where Z is clean, v = ε is unknown and guessed zero."""
    z, mean = torch.randn(2, 5), torch.randn(2, 5)
    alpha, sigma = (c[:, None] for c in alpha_sigma(torch.tensor([0.0, 1.0])))
    v, deviation = gaussian_velocity(z, mean, 0.2, alpha, sigma)
    torch.testing.assert_close(v, torch.stack([torch.zeros(5), -mean[1]]))
    torch.testing.assert_close(deviation, torch.tensor([[1.0], [0.2]]))
