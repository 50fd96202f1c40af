import math
from collections import Counter

import pytest
import torch
import torch.nn.functional as F

from model_fixtures import config
from nerfdiff.diffusion.blocks import Attention, Upsample, time_embedding
from nerfdiff.diffusion.deep_features import DeepFeatures, DeepReuse
from nerfdiff.diffusion.unet import Stage, UNet
from nerfdiff.utils.errors import ConfigError

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


@pytest.mark.parametrize("checkpointing", [True, [1], [2], [1, 2]])
def test_checkpointing_changes_memory_not_gradients(checkpointing):
    x, t = torch.randn(2, 3, 8, 8), torch.rand(2)
    gradients = []
    for choice in (False, checkpointing):
        net = unet(checkpointing=choice)
        net(x, t)[0].square().sum().backward()
        gradients.append([p.grad for p in net.parameters()])
    for plain, recomputed in zip(*gradients, strict=True):
        torch.testing.assert_close(plain, recomputed)


@pytest.mark.parametrize(
    ("checkpointing", "sizes"), [(False, set()), (True, {8, 4}), ("auto", {8, 4}), ([1], {8}), ([2], {4}), ([], set())]
)
def test_only_the_chosen_resolutions_are_recomputed(checkpointing, sizes):
    net, runs = unet(checkpointing=checkpointing), {8: 0, 4: 0}
    for module in net.modules():
        if isinstance(module, Stage):
            module.register_forward_pre_hook(
                lambda _, inputs: runs.update(Counter([inputs[0].shape[-1]]) + Counter(runs))
            )
    loss = net(torch.randn(1, 3, 8, 8), torch.rand(1))[0].square().sum()
    once = dict(runs)
    loss.backward()
    assert {size for size in runs if runs[size] == 2 * once[size]} == sizes
    assert all(runs[size] == once[size] for size in runs if size not in sizes)


@pytest.mark.parametrize("checkpointing", [[3], [1, 4], "flase"])
def test_a_resolution_that_there_is_not_is_refused(checkpointing):
    with pytest.raises(ConfigError, match=r"must be auto, true, false, or some of \[1, 2\]"):
        unet(checkpointing=checkpointing)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_views_share_the_keys_of_their_scene(dtype):
    """A context per scene, or keys and values of it, says the same as one repeated for each view."""
    net = unet(cross_attention=True).to(dtype)
    _, features = unet(with_time=False).to(dtype)(torch.randn(2, 3, 8, 8, dtype=dtype))
    x, t = torch.randn(6, 3, 8, 8, dtype=dtype), torch.rand(6, dtype=dtype)
    expected, _ = net(x, t, [feature.repeat_interleave(3, 0) for feature in features])
    tolerance = {"atol": 1e-4, "rtol": 1e-4} if dtype == torch.float32 else {"atol": 1e-12, "rtol": 1e-10}
    torch.testing.assert_close(net(x, t, features)[0], expected, **tolerance)
    torch.testing.assert_close(net(x, t, net.keys_values(features))[0], expected, **tolerance)


def test_a_context_of_another_length_is_refused():
    net, x, t = unet(cross_attention=True), torch.randn(1, 3, 8, 8), torch.rand(1)
    _, features = unet(with_time=False)(x)
    with pytest.raises(ValueError, match="zip"):
        net(x, t, features[:-1])


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("cross", [False, True])
def test_fused_attention_can_take_what_it_is_given(layout, cross, monkeypatch):
    """Kernels ask for a dense last axis; the image keeps its layout."""
    seen = []
    fused = F.scaled_dot_product_attention

    def watched(q, k, v):
        seen.extend((q, k, v))
        return fused(q, k, v)

    monkeypatch.setattr(F, "scaled_dot_product_attention", watched)
    x = torch.randn(4, 64, 3, 5).to(memory_format=layout)
    out = Attention(64, 32, cross)(x, x[:2] if cross else None)
    assert all(tensor.stride(-1) == 1 for tensor in seen)
    assert out.is_contiguous(memory_format=layout)


@pytest.mark.parametrize("size", [(4, 6), (1, 1), (5, 3)])
def test_doubling_by_a_transposed_convolution_is_nearest_neighbours_then_convolution(size):
    layer, target = Upsample(32).double(), tuple(2 * side for side in size)
    x = torch.randn(2, 32, *size, dtype=torch.float64, requires_grad=True)
    fast = layer(x, target)
    plain = layer.conv(F.interpolate(x, size=target, mode="nearest"))
    torch.testing.assert_close(fast, plain, atol=1e-12, rtol=1e-10)
    weights = torch.randn_like(plain)
    inputs = (x, *layer.parameters())
    for one, other in zip(*(torch.autograd.grad((y * weights).sum(), inputs) for y in (fast, plain)), strict=True):
        torch.testing.assert_close(one, other, atol=1e-11, rtol=1e-10)


def test_deep_levels_are_computed_at_every_so_many_calls():
    net, lowest, shallow = unet(), [], []
    net.middle[0].register_forward_hook(lambda *_: lowest.append(1))
    net.down[0].register_forward_hook(lambda *_: shallow.append(1))
    x, deep = torch.randn(1, 3, 8, 8), DeepFeatures(DeepReuse(every=3, below=1))
    for step in range(7):
        deep.advance()
        net(x, torch.tensor([0.9 - 0.1 * step]), deep=deep)
    assert (len(shallow), len(lowest)) == (7, 3)


def test_reused_deep_levels_say_what_they_said_and_shallow_ones_what_they_would():
    net, t = unet(), torch.tensor([0.5])
    x, other = torch.randn(2, 1, 3, 8, 8)
    deep = DeepFeatures(DeepReuse(every=2, below=1))
    deep.advance()
    exact, _ = net(x, t)
    torch.testing.assert_close(net(x, t, deep=deep)[0], exact)  # computed
    deep.advance()
    torch.testing.assert_close(net(x, t, deep=deep)[0], exact)  # the same input: nothing is lost
    reused, expected = net(other, t, deep=deep)[0], net(other, t)[0]
    assert not torch.allclose(reused, expected, atol=1e-4)  # another: something is
    held = deep.last
    deep.advance()
    torch.testing.assert_close(net(other, t, deep=deep)[0], expected)
    assert not torch.equal(deep.last, held)


def test_there_must_be_levels_to_reuse():
    deep = DeepFeatures(DeepReuse(every=2, below=2))
    with pytest.raises(ConfigError, match=r"below=2: of 2 resolutions none is left"):
        unet()(torch.randn(1, 3, 8, 8), torch.rand(1), deep=deep)
    with pytest.raises(ConfigError, match=r"deep\.every=0"):
        DeepReuse(every=0, below=1)


def test_a_width_groupnorm_cannot_split_is_refused():
    with pytest.raises(ValueError, match="multiple of 32"):
        unet(width=40)


def test_patches_move_the_work_to_smaller_images():
    """A U-Net on patches of 2 pixels is the plain one on images of half the side and four times the channels."""
    plain = UNet(12, 20, **SMALL, with_time=True, cross_attention=False, zero_output=False)
    on_patches = unet(patch=2, attention_downsampling=[2 * d for d in SMALL["attention_downsampling"]])
    on_patches.load_state_dict(plain.state_dict())
    x, t = torch.randn(2, 3, 16, 24), torch.rand(2)
    out, features = on_patches(x, t)
    # channel c of the small image at (row i, column j of the patch) is channel 4c + 2i + j
    small = torch.stack([x[:, :, i::2, j::2] for i in (0, 1) for j in (0, 1)], 2).flatten(1, 2)
    expected, expected_features = plain(small, t)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        torch.testing.assert_close(out[:, :, i::2, j::2], expected[:, 2 * i + j :: 4], atol=1e-5, rtol=1e-5)
    assert [f.shape for f in features] == [f.shape for f in expected_features]


def test_patches_are_whole_and_levels_count_from_the_input():
    with pytest.raises(
        ConfigError, match=r"model\.unet\.patch=2: images of 15x20 pixels are not made of whole patches"
    ):
        unet(patch=2, attention_downsampling=[4])(torch.randn(1, 3, 15, 20), torch.rand(1))
    with pytest.raises(ConfigError, match=r"model\.unet\.patch=0"):
        unet(patch=0)
    with pytest.raises(ConfigError, match=r"some of \[2, 4\]"):
        unet(patch=2, checkpointing=[1])
