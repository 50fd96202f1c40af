"""Compiled U-Nets against plain ones, for a process of its own: the type checks of tests cannot be compiled.

python compiled_unets.py <backend> <cache>
"""

import copy
import pickle
import sys

import torch
from torch._dynamo.utils import counters

from model_fixtures import model
from nerfdiff.compilation import REGIONS, compile_unets
from nerfdiff.diffusion.deep_features import DeepFeatures, DeepReuse
from nerfdiff.model import NerfDiff

TIMES = torch.tensor([0.3, 0.4])


def build(**sizes) -> NerfDiff:
    net = model(unet=sizes)
    for parameter in net.parameters():  # residual branches start at zero: give them something to do
        if parameter.abs().sum() == 0:
            torch.nn.init.normal_(parameter, std=0.1)
    return net


def train(net: NerfDiff, images: torch.Tensor) -> list[torch.Tensor]:
    """One step's output and gradients."""
    out, features = net.encoder.unet(images[:1, :3])
    denoised = net.denoiser.unet(images, TIMES, features)[0]
    (denoised.square().sum() + out.square().mean()).backward()
    return [denoised, *(parameter.grad for parameter in net.encoder.unet.parameters())]


@torch.no_grad()
def sample(net: NerfDiff, images: torch.Tensor) -> list[torch.Tensor]:
    """Two views of one scene at several steps, every other one with deep features of the last."""
    _, features = net.encoder.unet(images[:1, :3])
    context, deep = net.denoiser.unet.keys_values(features), DeepFeatures(DeepReuse(2, 1))
    outputs = []
    for step in range(3):
        deep.advance()
        outputs.append(net.denoiser.unet(images, TIMES - 0.1 * step, context, deep)[0])
    return outputs


def same(one: list[torch.Tensor], other: list[torch.Tensor]) -> None:
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


if __name__ == "__main__":
    backend, cache = sys.argv[1:]
    # the smallest U-Net that shows it
    generated = {"channel_mult": [1], "res_blocks": 0, "attention_downsampling": []}
    sizes = generated if backend == "inductor" else {"checkpointing": [2], "channel_mult": [1, 1]}
    plain, images = build(**sizes), torch.rand(2, 6, 8, 8, generator=torch.Generator().manual_seed(0))
    # generated code takes seconds per kernel
    for choice in ("unets",) if backend == "inductor" else REGIONS:
        plain.zero_grad()
        net = copy.deepcopy(plain)
        compile_unets(net, choice, cache, backend)
        assert list(net.state_dict()) == list(plain.state_dict())
        assert all(bool(m._compiled_call_impl) == isinstance(m, REGIONS[choice]) for m in net.modules())
        if backend == "inductor":
            with torch.no_grad():
                same([net.encoder.unet(images[:, :3])[0]], [plain.encoder.unet(images[:, :3])[0]])
        else:
            same(train(net, images), train(plain, images))
            same(sample(net, images), sample(plain, images))
            with torch.autocast("cpu", torch.bfloat16):
                assert torch.isfinite(sample(net, images)[0]).all()
            copies = copy.deepcopy(net), pickle.loads(pickle.dumps(net))
            same(sample(copies[0], images), sample(copies[1], images))
        assert not counters["graph_break"], counters["graph_break"]
        assert counters["frames"]["ok"] > 0
        counters.clear()
    print("same")
