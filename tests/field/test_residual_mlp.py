import math

import numpy as np
import pytest
import torch

from nerfdiff.field.residual_mlp import ResidualMLP
from nerfdiff.utils.errors import ConfigError


def mlp(injections: int = 2, **changes) -> ResidualMLP:
    torch.manual_seed(0)
    sizes = {"channels": 5, "hidden": 8, "blocks": 3, "frequencies": 2, "first_frequency": 1.5}
    made = ResidualMLP(**sizes | changes, injections=injections, density_shift=-2.0, density_scale=3.0)
    for parameter in made.parameters():  # biases and the blocks' second layers begin as zero
        torch.nn.init.normal_(parameter, std=0.4)
    return made


def by_hand(net: ResidualMLP, x, d, features) -> tuple[list[float], float]:
    """One point, in float64, from the state's names alone."""
    state = {name: value.double().numpy() for name, value in net.state_dict().items()}

    def linear(name, v):
        return state[f"{name}.weight"] @ v + state[f"{name}.bias"]

    encoding = list(x)
    for wave in (math.sin, math.cos):
        for octave in range(2):
            encoding += [wave(1.5 * 2**octave * c) for c in x]
    h = linear("position", np.array([*encoding, *d]))
    for block in range(3):
        if block < len(net.features):
            h = h + linear(f"features.{block}", features)
        inner = linear(f"blocks.{block}.first", np.maximum(h, 0))
        h = h + linear(f"blocks.{block}.second", np.maximum(inner, 0))
    out = linear("output", np.maximum(h, 0))
    return [1 / (1 + math.exp(-c)) for c in out[:3]], 3 * math.log1p(math.exp(out[3] - 2))


@pytest.mark.parametrize("injections", [1, 2, 3])
def test_colour_and_density_by_hand(injections):
    net, generator = mlp(injections), np.random.default_rng(1)
    inputs = [generator.normal(size=(6, n)) for n in (3, 3, 5)]
    with torch.no_grad():
        rgb, density = net(*(torch.tensor(v, dtype=torch.float32) for v in inputs))
    for i, (x, d, features) in enumerate(zip(*inputs, strict=True)):
        colour, expected = by_hand(net, x, d, features)
        assert rgb[i].tolist() == pytest.approx(colour, abs=1e-5)
        assert float(density[i]) == pytest.approx(expected, rel=1e-4)


def test_one_injection_is_a_layer_over_all_inputs_side_by_side():
    """VisionNeRF's first layer: of the encoding, the direction and the features together."""
    net = mlp(injections=1)
    x, d, features = torch.randn(7, 3), torch.randn(7, 3), torch.randn(7, 5)
    weight = torch.cat([net.position.weight, net.features[0].weight], 1)
    inputs = torch.cat([net.encoded(x), d, features], -1)
    first = inputs @ weight.T + net.position.bias + net.features[0].bias
    seen = []
    net.blocks[0].register_forward_hook(lambda block, arguments, out: seen.append(arguments[0]))
    net(x, d, features)
    torch.testing.assert_close(seen[0], first)


def test_space_begins_nearly_empty_and_the_blocks_as_the_identity():
    torch.manual_seed(0)
    net = ResidualMLP(512, 512, 5, 3, 6, 1.5, -3.0, 32.0)
    _, density = net(
        torch.rand(256, 3) - 0.5, torch.nn.functional.normalize(torch.randn(256, 3), dim=-1), torch.randn(256, 512)
    )
    assert 0.2 < density.median() < 8  # optical depth across the frustum
    x = torch.randn(4, 512)
    torch.testing.assert_close(net.blocks[0](x), x)


def test_positions_are_encoded_in_full_precision_under_autocast():
    net, x = mlp(frequencies=10), torch.rand(64, 3)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(net.encoded(x), net.encoded(x.double()).float(), atol=2e-4, rtol=0)


@pytest.mark.parametrize("injections", [0, 4])
def test_injections_must_fit_the_blocks(injections):
    with pytest.raises(ConfigError, match=r"model\.field\.mlp\.injections"):
        mlp(injections)
