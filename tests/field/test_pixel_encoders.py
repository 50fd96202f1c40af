import pytest
import torch
import torchvision
from torch import nn

from nerfdiff.field.resnet import ResNetPyramid
from nerfdiff.field.vision_features import Reassembled, VisionFeatures
from nerfdiff.field.vision_transformer import TransformerBlock, VisionTransformer
from nerfdiff.utils.errors import ConfigError
from pixel_fixtures import ENCODERS


def test_the_pyramid_is_torchvisions_resnet_34():
    """The same weights in torchvision's network, walked through as pixelNeRF does."""
    torch.manual_seed(0)
    ours = ResNetPyramid([64, 64, 128, 256], [3, 4, 6], stride=2, pool=True, groups=32).eval()
    theirs = torchvision.models.resnet34(norm_layer=lambda width: nn.GroupNorm(32, width)).eval()
    own = iter(ours.state_dict().values())
    theirs.load_state_dict(
        {name: value if name.startswith(("layer4", "fc")) else next(own) for name, value in theirs.state_dict().items()}
    )
    assert next(own, None) is None
    image = torch.randn(1, 3, 64, 48)
    x = theirs.relu(theirs.bn1(theirs.conv1(image)))
    levels = [x]
    x = theirs.maxpool(x)
    for layer in (theirs.layer1, theirs.layer2, theirs.layer3):
        x = layer(x)
        levels.append(x)
    found = ours(image)
    assert found.shape == (1, 512, 32, 24)
    for level, own in zip(levels, found.split([64, 64, 128, 256], 1), strict=True):
        enlarged = nn.Upsample(size=(32, 24), mode="bilinear")(level)
        torch.testing.assert_close(own, enlarged, atol=1e-4, rtol=1e-4)


def test_a_transformer_block_is_pytorchs():
    torch.manual_seed(0)
    ours = TransformerBlock(24, 4, 40)
    theirs = nn.TransformerEncoderLayer(
        24, 4, 40, dropout=0.0, activation="gelu", layer_norm_eps=1e-6, batch_first=True, norm_first=True
    )
    names = {
        "self_attn.in_proj_weight": "query_key_value.weight",
        "self_attn.in_proj_bias": "query_key_value.bias",
        "self_attn.out_proj.weight": "attended.weight",
        "self_attn.out_proj.bias": "attended.bias",
        "norm1.weight": "norm_attention.weight",
        "norm1.bias": "norm_attention.bias",
        "norm2.weight": "norm_mlp.weight",
        "norm2.bias": "norm_mlp.bias",
        "linear1.weight": "mlp.0.weight",
        "linear1.bias": "mlp.0.bias",
        "linear2.weight": "mlp.2.weight",
        "linear2.bias": "mlp.2.bias",
    }
    state = ours.state_dict()
    assert len(names) == len(state)
    theirs.load_state_dict({name: state[own] for name, own in names.items()})
    x = torch.randn(2, 7, 24)
    torch.testing.assert_close(ours(x), theirs(x), atol=1e-5, rtol=1e-5)


def test_the_papers_transformer_is_vit_b_16():
    """As many parameters as torchvision's, but for its last norm and its head."""
    with torch.device("meta"):
        ours = VisionTransformer(16, 8, 768, 12, 3072, [2, 5, 8, 11])
        theirs = torchvision.models.VisionTransformer(128, 16, 12, 12, 768, 3072)
    count = {name: p.numel() for name, p in theirs.named_parameters()}
    left_out = sum(n for name, n in count.items() if name.startswith(("heads.", "encoder.ln.")))
    assert sum(p.numel() for p in ours.parameters()) == sum(count.values()) - left_out


def test_tokens_stay_where_their_patches_are():
    """Without attention a token knows its own patch alone: changing one patch changes one token."""
    torch.manual_seed(0)
    net = VisionTransformer(4, 3, 16, 2, 32, [1])
    for block in net.blocks:
        nn.init.zeros_(block.attended.weight)
    image = torch.randn(1, 3, 12, 20)
    changed = image.clone()
    changed[..., 4:8, 12:16] += 1
    (before, _), (after, _) = net(image)[0], net(changed)[0]
    moved = (before != after).any(1)[0]
    assert before.shape == (1, 16, 3, 5) and moved[1, 3] and moved.sum() == 1


def test_positions_are_resized_as_an_image():
    net = VisionTransformer(4, 2, 8, 2, 8, [0])
    assert torch.equal(net.positions_for(2, 2), net.positions)
    larger = net.positions_for(4, 6)
    assert larger.shape == (1, 25, 8) and torch.equal(larger[:, 0], net.positions[:, 0])
    torch.testing.assert_close(larger[0, 1], net.positions[0, 1])  # corners of the one are corners of the other
    torch.testing.assert_close(larger[0, -1], net.positions[0, -1])


def test_class_tokens_are_read_out_into_every_pixel():
    torch.manual_seed(0)
    net = Reassembled(6, 4, 1, 3)
    tokens, readout = torch.randn(1, 6, 2, 3), torch.randn(1, 6)
    joined = torch.cat([tokens[0, :, 1, 2], readout[0]])
    read = nn.functional.gelu(net.readout.weight @ joined + net.readout.bias)
    pixel = net.project.weight[:, :, 0, 0] @ read + net.project.bias
    seen = []
    net.resize.register_forward_hook(lambda module, arguments, out: seen.append(out))
    net(tokens, readout)
    torch.testing.assert_close(seen[0][0, :, 1, 2], pixel)


@pytest.mark.parametrize("size", [(16, 16), (16, 24), (10, 14), (7, 9)])
@pytest.mark.parametrize("name", ENCODERS)
def test_images_of_any_size_are_encoded_each_by_itself(name, size):
    torch.manual_seed(0)
    net = (ResNetPyramid if name == "pixelnerf" else VisionFeatures)(**ENCODERS[name])
    images = torch.randn(3, 3, *size)
    together = net(images)
    assert together.shape[:2] == (3, net.out_channels)
    halves = [-(-side // 2) if name == "pixelnerf" else side for side in size]
    assert list(together.shape[2:]) == halves
    torch.testing.assert_close(net(images[1:2]), together[1:2], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ENCODERS)
def test_every_parameter_learns(name):
    torch.manual_seed(0)
    net = (ResNetPyramid if name == "pixelnerf" else VisionFeatures)(**ENCODERS[name])
    net(torch.randn(2, 3, 16, 16)).square().sum().backward()
    still = [key for key, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("pixelnerf", {"channels": [8, 8]}, "channels=.* one more than blocks"),
        ("pixelnerf", {"groups": 3}, "groups=3 must divide"),
        ("visionnerf", {"features": 15}, "features=15 must be even"),
        ("visionnerf", {"reassembled": [4, 6]}, "four depths"),
        ("visionnerf", {"groups": 0}, "groups=0 must divide"),
    ],
)
def test_sizes_that_cannot_be_are_named(name, changes, words):
    with pytest.raises(ConfigError, match=words):
        (ResNetPyramid if name == "pixelnerf" else VisionFeatures)(**ENCODERS[name] | changes)


@pytest.mark.parametrize(
    ("changes", "words"), [({"heads": 3}, "heads=3"), ({"taps": [2, 1]}, "in order"), ({"taps": []}, "in order")]
)
def test_transformers_that_cannot_be_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        VisionTransformer(**ENCODERS["visionnerf"]["transformer"] | changes)
