import pytest
import torch

from model_fixtures import input_cameras, model
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.model import build_on_meta, settings_of


def counts(size: str) -> dict[str, int]:
    cfg = load_config("train", [f"model={size}"])
    return build_on_meta(settings_of(cfg)).parameter_count()


@pytest.mark.parametrize(("size", "encoder", "total"), [("base", 198e6, 438e6), ("large", 462e6, 1027e6)])
def test_the_papers_sizes(size, encoder, total):
    count = counts(size)
    assert count["encoder"] == pytest.approx(encoder, rel=5e-3)
    assert count["total"] == pytest.approx(total, rel=2e-3)


@pytest.mark.parametrize(("size", "expected"), [("base", 216_622_275), ("large", 507_325_955)])
def test_without_cross_attention_the_cdm_is_adms_unet(size, expected):
    cfg = load_config("train", [f"model={size}", "conditioning.cross_attention=false"])
    config = settings_of(cfg)
    assert build_on_meta(config).parameter_count()["denoiser"] == expected


def test_small_models_share_the_structure():
    tiny, small = counts("tiny"), counts("small")
    assert 1e6 < tiny["total"] < 10e6 < small["total"] < 60e6


def test_images_need_not_be_square():
    net = model()
    cameras = input_cameras(2, 12, 20)
    encoding = net.encode_images(torch.rand(2, 3, 12, 20), cameras, torch.full((2,), 0.8), torch.full((2,), 1.8))
    rendering = net.render(encoding, cameras[:, None])
    assert encoding.triplane.planes.shape == (2, 3, 8, 12, 20)
    assert rendering.images.shape == (2, 1, 3, 12, 20)
    z = torch.randn(2, 3, 12, 20)
    assert (
        net.denoiser(z, torch.full((2,), 0.3), net.condition(encoding, cameras[:, None], rendering.images)).shape
        == z.shape
    )


def test_scenes_of_a_batch_do_not_mix():
    net = model()
    cameras, near, far = input_cameras(3), torch.full((3,), 0.8), torch.full((3,), 1.8)
    source = torch.rand(3, 3, 16, 16)
    together = net.render(net.encode_images(source, cameras, near, far), cameras[:, None]).images
    for i in range(3):
        one = slice(i, i + 1)
        alone = net.encode_images(source[one], cameras[one], near[one], far[one])
        torch.testing.assert_close(net.render(alone, cameras[one, None]).images, together[one], atol=1e-5, rtol=0)


def test_a_batch_is_encoded_by_its_source_views():
    net, cameras, near, far = model(), input_cameras(2), torch.full((2,), 0.8), torch.full((2,), 1.8)
    pixels = torch.randint(0, 256, (2, 3, 16, 16), dtype=torch.uint8)
    names = ("a", "b")
    views = cameras, pixels[:, None], cameras[:, None]
    batch = ViewBatch(torch.arange(2), pixels, *views, near, far, names, names, (names, names))
    expected = net.encode_images(pixels.float() / 255, cameras, near, far)
    assert torch.equal(net.encode(batch).triplane.planes, expected.triplane.planes)
