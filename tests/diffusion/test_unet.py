import math

import pytest
import torch

from model_fixtures import config
from nerfdiff.diffusion.blocks import Attention, time_embedding
from nerfdiff.diffusion.unet import UNet

SMALL = config()["unet"]


def unet(with_time=True, cross_attention=False, zero_output=False, **changes) -> UNet:
    torch.manual_seed(0)
    net = UNet(3, 5, **SMALL | changes, with_time=with_time, cross_attention=cross_attention, zero_output=zero_output)
    for name, parameter in net.named_parameters():  # residual branches start at zero: give them something to do
        if parameter.abs().sum() == 0 and "norm" not in name and not zero_output:
            torch.nn.init.normal_(parameter, std=0.1)
    return net


def naive_attention(q, k, v):
    """Softmax attention of one head, [pixels, channels], by the definition."""
    scores = torch.exp(q @ k.T / math.sqrt(q.shape[1]))
    return scores / scores.sum(1, keepdim=True) @ v


@pytest.mark.parametrize("cross", [False, True])
def test_attention_equals_the_definition(cross):
    torch.manual_seed(0)
    layer = Attention(64, 32, cross)
    torch.nn.init.normal_(layer.out.weight)
    x, context = torch.randn(2, 2, 64, 3, 4)
    out = layer(x, context if cross else None)
    for sample in range(2):
        h = layer.norm(x)[sample].flatten(1).T
        source = layer.norm_context(context)[sample].flatten(1).T if cross else h
        q = h @ layer.query.weight[:, :, 0, 0].T + layer.query.bias
        kv = source @ layer.key_value.weight[:, :, 0, 0].T + layer.key_value.bias
        k, v = kv.split(64, dim=1)
        heads = [naive_attention(*(part[:, i : i + 32] for part in (q, k, v))) for i in (0, 32)]
        expected = torch.cat(heads, 1) @ layer.out.weight[:, :, 0, 0].T + layer.out.bias
        torch.testing.assert_close(out[sample], x[sample] + expected.T.reshape(64, 3, 4), atol=1e-4, rtol=1e-4)


def test_time_embedding_by_hand():
    embedded = time_embedding(torch.tensor([0.25]), 8)[0]
    angles = [250 * 10_000 ** (-i / 4) for i in range(4)]
    expected = [math.cos(a) for a in angles] + [math.sin(a) for a in angles]
    assert embedded.tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("size", [(16, 16), (15, 20), (9, 7)])
def test_any_image_size_comes_back(size):
    net = unet(channel_mult=[1, 2, 2], attention_downsampling=[4])
    out, features = net(torch.randn(2, 3, *size), torch.rand(2))
    assert out.shape == (2, 5, *size)
    assert len(features) == 1 + 1 + 2  # down, middle, up


def test_features_of_a_twin_fit_as_context():
    encoder, net = unet(with_time=False), unet(cross_attention=True)
    x = torch.randn(2, 3, 8, 8)
    _, features = encoder(x)
    first, _ = net(x, torch.rand(2), features)
    assert first.shape == (2, 5, 8, 8)


def test_cross_attention_and_time_are_used():
    net, x, t = unet(cross_attention=True), torch.randn(1, 3, 8, 8), torch.tensor([0.4])
    _, features = unet(with_time=False)(x)
    base, _ = net(x, t, features)
    changed = [*features[:-1], torch.randn_like(features[-1])]
    assert not torch.allclose(net(x, t, changed)[0], base, atol=1e-4)
    assert not torch.allclose(net(x, t + 0.3, features)[0], base, atol=1e-4)


def test_zero_output_starts_at_zero():
    out, _ = unet(zero_output=True)(torch.randn(1, 3, 8, 8), torch.rand(1))
    assert torch.equal(out, torch.zeros(1, 5, 8, 8))


def test_checkpointing_changes_memory_not_gradients():
    x, t = torch.randn(2, 3, 8, 8), torch.rand(2)
    gradients = []
    for checkpointing in (False, True):
        net = unet(checkpointing=checkpointing)
        net(x, t)[0].square().sum().backward()
        gradients.append([p.grad for p in net.parameters()])
    for plain, recomputed in zip(*gradients, strict=True):
        torch.testing.assert_close(plain, recomputed)


def test_a_width_groupnorm_cannot_split_is_refused():
    with pytest.raises(ValueError, match="multiple of 32"):
        unet(width=40)
