"""pixelNeRF and VisionNeRF in the place of the triplanes: the model, its strategies, its settings."""

import copy

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from model_fixtures import CONFIG, input_cameras, look_at
from nerfdiff.cameras import Cameras
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.field.field import PixelField
from nerfdiff.field.pixel_features import PixelFeatures
from nerfdiff.field.residual_mlp import ResidualMLP
from nerfdiff.model import NerfDiff, build_on_meta, settings_of
from nerfdiff.training.memory import training_memory
from nerfdiff.utils.errors import ConfigError
from pixel_fixtures import ENCODERS, pixel_config

NEAR, FAR = 0.8, 1.8


def net(name: str) -> NerfDiff:
    torch.manual_seed(0)
    made = NerfDiff(**pixel_config(name)).eval()
    for parameter in made.parameters():
        if not parameter.any():  # layers that begin as zero say nothing
            torch.nn.init.normal_(parameter, std=0.2)
    return made


def bounds(batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.full((batch,), NEAR), torch.full((batch,), FAR)


def other_cameras(batch: int, height: int = 16, width: int = 16) -> Cameras:
    """Two views of each scene, beside and above the input camera."""
    c2w = torch.stack([look_at((1.0, -0.2, 0.9)), look_at((-0.3, -0.9, 0.6))])
    K = input_cameras(1, height, width).K
    return Cameras(c2w.repeat(batch, 1, 1, 1), K.expand(batch, 2, 3, 3), height, width)


def scene(number: int = 0) -> ViewBatch:
    pixels = torch.randint(
        0, 256, (1, 3, 3, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(number)
    )
    return ViewBatch(
        draws=torch.arange(1),
        source_pixels=pixels[:, 0],
        source_cameras=input_cameras(1),
        target_pixels=pixels[:, 1:],
        target_cameras=other_cameras(1),
        near=torch.tensor([NEAR]),
        far=torch.tensor([FAR]),
        scene_ids=(f"scene{number}",),
        source_views=("input",),
        target_views=(("000", "001"),),
    )


def config(*overrides: str) -> dict:
    cfg = load_config("train", list(overrides))
    return settings_of(cfg)


@pytest.mark.parametrize("name", ENCODERS)
@torch.no_grad()
def test_a_ray_is_the_mlp_along_its_own_direction(name):
    """One ray at a time in float64, sample by sample; seen from behind the same points look different."""
    made = net(name)
    made.renderer = type(made.renderer)(uniform_samples=12, importance_samples=0, background=1.0, chunk=10**6)
    cameras = other_cameras(1)
    encoding = made.encode_images(torch.rand(1, 3, 16, 16), input_cameras(1), *bounds(1))
    image = made.render(encoding, cameras).images
    found, decoder = encoding.features, copy.deepcopy(made.decoder).double()
    rays = cameras.rays(*(b[:, None] for b in bounds(1)))
    for view, row, column in [(0, 3, 8), (1, 12, 5)]:
        origin, direction = (v[0, view, row, column].double() for v in (rays.origins, rays.directions))
        colour, left = np.zeros(3), 1.0
        for bin_ in range(12):
            x = origin + (NEAR + (bin_ + 0.5) / 12 * (FAR - NEAR)) * direction
            features, valid = found.sample(x[None, None].float())
            centred = x - torch.tensor([0, 0, 0.5 * (NEAR + FAR)], dtype=torch.float64)
            rgb, density = decoder(centred, direction, features[0, 0].double())
            alpha = 1 - np.exp(-float(density) / 12) if valid else 0.0  # FAR - NEAR is 1
            colour, left = colour + left * alpha * rgb.numpy(), left * (1 - alpha)
        np.testing.assert_allclose(image[0, view, :, row, column].numpy(), colour + left, atol=2e-5)
    field, x = PixelField.of(found, made.decoder), torch.tensor([[[0.1, 0.0, 1.2]]])
    ahead = torch.tensor([[[0.0, 0.0, 1.0]]])
    assert not torch.allclose(field(x, ahead)[0], field(x, -ahead)[0])


@pytest.mark.parametrize("name", ENCODERS)
def test_scenes_of_a_batch_do_not_mix_and_images_need_not_be_square(name):
    made, cameras, source = net(name), input_cameras(3, 12, 20), torch.rand(3, 3, 12, 20)
    views = other_cameras(3, 12, 20)
    together = made.render(made.encode_images(source, cameras, *bounds(3)), views).images
    assert together.shape == (3, 2, 3, 12, 20)
    for i in range(3):
        one = slice(i, i + 1)
        alone = made.encode_images(source[one], cameras[one], *bounds(1))
        torch.testing.assert_close(made.render(alone, views[one]).images, together[one], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ENCODERS)
def test_both_losses_reach_the_image_encoder(name):
    made = net(name)
    encoding = made.encode_images(torch.rand(2, 3, 16, 16), input_cameras(2), *bounds(2))
    views = other_cameras(2)
    rendering = made.render(encoding, views)
    condition = made.condition(encoding, views, rendering.images)
    velocity = made.denoiser.velocity(torch.randn(4, 3, 16, 16), torch.full((4,), 0.5), condition)
    for loss in (rendering.images.square().sum(), velocity.square().sum()):
        made.zero_grad()
        loss.backward(retain_graph=True)
        assert all(p.grad is not None and p.grad.any() for p in made.encoder.parameters())


@pytest.mark.parametrize("name", ENCODERS)
def test_recomputing_chunks_changes_nothing(name):
    made, views = net(name), other_cameras(1)
    gradients = []
    for chunk in (10**6, 600):
        made.renderer = type(made.renderer)(uniform_samples=6, importance_samples=6, background=1.0, chunk=chunk)
        made.zero_grad()
        source = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
        made.render(made.encode_images(source, input_cameras(1), *bounds(1)), views).images.square().sum().backward()
        gradients.append([p.grad for part in (made.encoder, made.decoder) for p in part.parameters()])
    for whole, parts in zip(*gradients, strict=True):
        torch.testing.assert_close(parts, whole, atol=1e-3, rtol=1e-3)


def strategy(name: str):
    words = ["ckpt=x", f"strategy={name}", "budget=minutes", "prior=sphere", "prior.views=2", "strategy.steps=2"]
    if name == "none":
        words = words[:2]
    elif name == "cdm":
        words.pop(3), words.pop(3)
    else:
        words.pop()
    return instantiate(load_config("distill", words).strategy)


@pytest.mark.parametrize("name", ENCODERS)
def test_none_renders_it_and_cdm_is_conditioned_on_it(name):
    made, scenes = net(name), [scene(0), scene(1)]
    rendered = strategy("none").predict(made, scenes, seed=0)
    assert [views.field for views in rendered] == [None, None]
    assert rendered[0].images.shape == (2, 3, 16, 16) and rendered[0].depth.shape == (2, 16, 16)
    assert rendered[0].field_queries == 2 * 16 * 16 * 12 and rendered[0].denoiser_calls == 0
    assert not torch.equal(rendered[0].images, rendered[1].images)
    sampled = strategy("cdm").predict(made, scenes, seed=0)
    assert sampled[0].images.shape == (2, 3, 16, 16) and sampled[0].denoiser_calls == 4


@pytest.mark.parametrize("name", ["ngd", "ngd_current", "direct", "sds", "stochastic"])
def test_what_fits_triplanes_says_what_it_needs_before_it_works(name, monkeypatch):
    made = net("pixelnerf")
    monkeypatch.setattr(made, "render", lambda *args: pytest.fail("rendered"))
    with pytest.raises(ConfigError, match=r"pixel-aligned.*strategy=none.*cdm.*field=triplane"):
        strategy(name).predict(made, [scene()], seed=0)


def test_a_name_or_an_attention_that_cannot_be_is_named():
    with pytest.raises(ConfigError, match=r"model\.field\.name='nerf': choose pixelnerf, triplane, visionnerf"):
        NerfDiff(**pixel_config("pixelnerf") | {"field": {"name": "nerf"}})
    attending = pixel_config("pixelnerf")
    attending["conditioning"]["cross_attention"] = True
    with pytest.raises(ConfigError, match=r"conditioning\.cross_attention=false"):
        NerfDiff(**attending)


def test_settings_without_a_name_are_of_triplanes():
    assert "name" not in CONFIG["field"] and build_on_meta(CONFIG).field_name == "triplane"
    named = config("model=tiny")
    assert named["field"]["name"] == build_on_meta(named).field_name == "triplane"


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("model", ["tiny", "large"])
def test_every_field_goes_with_every_model(name, model):
    made = config(f"model={model}", f"field={name}")
    assert made["field"].keys() == {"name", "encoder", "mlp", "density_shift", "density_scale"}  # no triplane's
    assert made["field"]["mlp"]["hidden"] == (64 if model == "tiny" else 512)
    assert build_on_meta(made).field_name == name


def test_an_experiments_model_has_the_sizes_of_its_own_and_the_run_the_fields_name():
    cfg = load_config("train", ["experiment=demo_checkpoint", "field=pixelnerf"])
    assert cfg.model.field.mlp.hidden == 64 and not cfg.conditioning.cross_attention
    assert load_config("train", ["model=tiny", "field=visionnerf"]).run_name == "srn_cars-tiny-visionnerf"


def test_the_authors_sizes():
    """Counted by hand from the published configurations: ResNet-34 without its last stage and head; ViT-B/16 without
    its last norm and head; two MLPs each there, one here."""
    pixel, vision = (build_on_meta(config("model=base", f"field={name}")).parameter_count() for name in ENCODERS)
    assert pixel["encoder"] == 21_797_672 - 513_000 - 13_114_368
    block, width = 2 * (512 * 512 + 512), 512

    def mlp(octaves: int, channels: int, blocks: int, injections: int) -> int:
        encoding = 3 + 6 * octaves + 3
        return encoding * width + width + injections * (channels * width + width) + blocks * block + width * 4 + 4

    assert pixel["decoder"] == mlp(6, 512, 5, 3) and vision["decoder"] == mlp(10, 515, 6, 1)
    transformer = 85_798_656 - (197 - 65) * 768 - 2 * 768  # for 64 patches, not 196
    assert transformer < vision["encoder"] < transformer + 40e6


def test_the_overrides_of_a_field_are_its_own():
    made = config("model=tiny", "field=visionnerf", "model.field.mlp.hidden=32")
    assert made["field"]["mlp"]["hidden"] == 32
    with pytest.raises(ConfigError, match="channels"):
        config("model=tiny", "field=visionnerf", "model.field.channels=4")


def test_a_training_steps_memory_is_known_before_it_runs():
    """Traced as for triplanes: less where chunks are recomputed."""
    made = pixel_config("visionnerf")
    whole = training_memory(made, 1, 1, 16, 16, "32-true").step
    made["render"]["chunk"] = 500
    assert 0 < training_memory(made, 1, 1, 16, 16, "32-true").step < whole


@pytest.mark.parametrize("channels", [[4], [40], [40, 3], [3, 40]])
def test_layers_on_pixels_give_what_layers_on_points_give(channels):
    """32 numbers are injected: maps of 40 channels are worked on before, those of 3 or 4 after they are sampled."""
    torch.manual_seed(0)
    decoder = ResidualMLP(sum(channels), 16, 3, 2, 3, 1.5, -1.0, 16.0).double()
    for parameter in decoder.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    maps = [torch.randn(2, n, 5 + n % 3, 6, dtype=torch.float64, requires_grad=True) for n in channels]
    near, far = (b.double() for b in bounds(2))
    features = PixelFeatures(maps, input_cameras(2).to(torch.float64), near, far)
    field = PixelField.of(features, decoder)
    assert [weight is None for weight in field.weights] == [n == 40 for n in channels]
    points, directions = torch.randn(2, 50, 3).double() * 0.4, torch.randn(2, 50, 3).double()
    points[..., 2] += 1.3
    sampled, valid = features.sample(points)
    rgb, density = decoder(features.centred(points), directions, sampled)
    expected = rgb, torch.where(valid, density / (far - near)[:, None], 0.0)
    found = field(points, directions)
    leaves = [*maps, *decoder.parameters()]
    gradients = [torch.autograd.grad(sum(v.square().sum() for v in values), leaves) for values in (found, expected)]
    for value, reference in zip((*found, *gradients[0]), (*expected, *gradients[1]), strict=True):
        torch.testing.assert_close(value, reference)
