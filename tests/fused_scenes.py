"""Random triplane fields and rays, rendered by the kernels and by the float64 reference."""

import os
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.arguments import Bundle, Fields, Settings
from nerfdiff.render.kernels.function import fused_render
from nerfdiff.render.kernels.texels import hidden_texels
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import KEPT

os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # where a fixed order is asked of PyTorch
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
NAMES = ("planes", "w1", "b1", "w2", "b2", "origins", "directions")
IMAGE = 18, 14  # width, height

LAUNCHES = passes._look, passes._gradient


def without_trials(monkeypatch) -> None:
    """First block sizes only: on a GPU, trials would compile each kernel several times for every size."""
    for launch in LAUNCHES:
        monkeypatch.setattr(launch, "_tuned", None)


@dataclass
class Case:
    """Sizes, and what is drawn from them."""

    scenes: int = 1
    n: int = 2
    channels: int = 5
    hidden: int = 6
    plane: tuple[int, int] = (3, 4)
    uniform: int = 3
    importance: int = 3
    background: float | None = 1.0
    jittered: bool = True
    cached: bool = False
    own_decoders: bool = False
    shift: float = -1.0
    scale: float = 8.0
    seed: int = 0

    def __post_init__(self):
        g = torch.Generator().manual_seed(self.seed)

        def normal(*shape):
            return torch.randn(*shape, generator=g)

        scenes, n, decoders = self.scenes, self.n, (self.scenes,) if self.own_decoders else ()
        directions = 0.3 * normal(scenes, n, 3) + torch.tensor([0.0, 0.0, 1.0])
        self.leaves = [
            2 * normal(scenes, 3, self.channels, *self.plane),
            normal(*decoders, self.hidden, self.channels) / self.channels**0.5,
            normal(*decoders, self.hidden),
            normal(*decoders, 4, self.hidden) / self.hidden**0.5,
            normal(*decoders, 4),
            0.1 * normal(scenes, n, 3),
            directions / directions.norm(dim=-1, keepdim=True),
        ]
        K = torch.tensor([[20.0, 0, 9.3], [0, 22.0, 6.8], [0, 0, 1]]).repeat(scenes, 1, 1)
        K[:, 0, 0] += torch.rand(scenes, generator=g)
        self.K = K
        self.near, self.far = 0.8 + 0.1 * torch.rand(scenes, generator=g), 1.9 + 0.1 * torch.rand(scenes, generator=g)
        self.ray_near = 0.7 + 0.1 * torch.rand(scenes, n, generator=g)
        self.ray_far = 2.0 + 0.1 * torch.rand(scenes, n, generator=g)
        samples = self.uniform + self.importance
        self.jitter = torch.rand(scenes, n, samples, generator=g) if self.jittered else None
        self.d_outputs = normal(scenes, n, 3), normal(scenes, n), normal(scenes, n)
        # as of an earlier look, which need not have met what is there now
        weights = torch.rand(scenes, n, self.uniform, generator=g).pow(4).to(KEPT)
        self.coarse = weights if self.cached else None

    @property
    def renderer(self) -> Renderer:
        return Renderer(self.uniform, self.importance, self.background, 10**7, backend="torch")

    def field(self, leaves) -> TriplaneField:
        """Of parameters w1, b1, w2, b2 and planes, on their device and of their type."""
        planes, *parameters = leaves[:5]
        decoder = Decoder(self.channels, self.hidden, self.shift, self.scale)
        for i, layer in enumerate((decoder.hidden, decoder.output)):
            layer.weight, layer.bias = (torch.nn.Parameter(p) for p in parameters[2 * i : 2 * i + 2])
        cameras = Cameras(torch.eye(4).expand(self.scenes, 4, 4), self.K, IMAGE[1], IMAGE[0]).to(planes)
        return TriplaneField(Triplane(planes, cameras, self.near.to(planes), self.far.to(planes)), decoder)

    def rays(self, leaves) -> Rays:
        return Rays(*leaves[5:], self.ray_near.to(leaves[5]), self.ray_far.to(leaves[5]))

    def reference(self, distances: Tensor | None = None) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Outputs and gradients by the PyTorch renderer, in float64.

        Args:
            distances: [scenes, n, samples], ascending; None leaves it to the renderer where to look.
        """
        leaves = [leaf.to(DEVICE).double().requires_grad_() for leaf in self.leaves]
        field = self.field(leaves)
        decoder = (field.decoder.hidden.weight, field.decoder.hidden.bias)
        leaves[1:5] = *decoder, field.decoder.output.weight, field.decoder.output.bias
        rays = self.rays(leaves)
        if distances is None:
            jitter = None if self.jitter is None else self.jitter.to(DEVICE).double()
            out = self.renderer.render(field, rays, jitter, None if self.coarse is None else self.coarse.to(DEVICE))
            outputs = [out.rgb, out.opacity, out.depth]
        else:
            distances = distances.to(DEVICE).double()
            outputs = list(self.renderer._composite(rays, distances, *self.renderer._query(field, rays, distances)))
        return _with_gradients(outputs, leaves, self.d_outputs, NAMES)

    def packed(self, half: bool = False) -> tuple[Fields, Bundle]:
        """As kernels read them."""
        table = hidden_texels(*(leaf.to(DEVICE) for leaf in self.leaves[:3]), half)
        more = (value.to(DEVICE) for value in (self.K, self.near, self.far, *self.leaves[3:5]))
        rays = (*self.leaves[5:], self.ray_near, self.ray_far, self.jitter, self.coarse)
        return Fields(table, *more), Bundle(*(None if value is None else value.to(DEVICE) for value in rays))

    def settings(
        self, half: bool = False, ordered: bool = False, points: int = 10**6, least_transmittance: float = 0.0
    ) -> Settings:
        samples, decoder = (self.uniform, self.importance, self.background), (self.shift, self.scale)
        return Settings(*samples, points, points, half, ordered, *IMAGE, *decoder, least_transmittance)

    def render(self, leaves, settings: Settings, keep_coarse: bool = False):
        """Colour, opacity and depth by the kernels for these leaves; and coarse weights where they are to be kept."""
        fixed = (self.K, self.near, self.far, self.ray_near, self.ray_far, self.jitter, self.coarse)
        there = (None if t is None else t.to(DEVICE) for t in fixed)
        outputs = fused_render(settings, _no_recovery, keep_coarse, *leaves, *there)
        return outputs if keep_coarse else outputs[:3]

    def fused(self, wanted: Sequence[str] = NAMES, **settings) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Outputs by the kernels, and the gradients that are wanted."""
        leaves = [leaf.to(DEVICE).requires_grad_(name in wanted) for name, leaf in zip(NAMES, self.leaves, strict=True)]
        outputs = self.render(leaves, self.settings(**settings))
        return _with_gradients(outputs, leaves, self.d_outputs, wanted)

    def rounding_decides(self, distances: Tensor, margin: float = 2e-5) -> Tensor:
        """Of which rays [scenes, n] a sample is so near to a jump that fp32 may see it on the other side.

        Density jumps at the near plane, and slopes do from texel to texel.
        """
        leaves = [leaf.double() for leaf in self.leaves]
        points = self.rays(leaves).at(distances.double())
        places, valid = self.field(leaves).triplane.frustum_coordinates(points.flatten(1, 2))
        places, valid = 0.5 * (places + 1).reshape(points.shape), valid.reshape(distances.shape)
        near = (points[..., 2] - self.near.double()[:, None, None]).abs() < margin
        height, width = self.plane
        for axis, sizes in enumerate(((width,), (height,), (height, width))):
            for size in sizes:
                position = places[..., axis] * size - 0.5
                near |= valid & ((position - position.round()).abs() < margin)
        return near.any(-1)


def drawn_case(draw: random.Random) -> Case:
    """Any shape out of the product of all, with inputs of its own."""
    importance = draw.choice((0, 1, 2, 3, 5, 8))
    return Case(
        scenes=draw.randint(1, 3),
        n=draw.randint(1, 40),
        channels=draw.choice((1, 3, 8, 16, 17, 24)),
        hidden=draw.choice((1, 6, 16, 20, 33)),
        plane=(draw.randint(1, 9), draw.randint(1, 9)),
        uniform=draw.choice((1, 2, 3, 5, 8)),
        importance=importance,
        background=draw.choice((None, 0.0, 0.4, 1.0)),
        jittered=draw.random() < 0.5,
        cached=importance > 0 and draw.random() < 0.3,
        own_decoders=draw.random() < 0.5,
        seed=draw.randrange(2**31),
    )


def _no_recovery(error, *_):
    raise error


def _with_gradients(outputs, leaves, d_outputs, wanted):
    leaves = [leaf for name, leaf in zip(NAMES, leaves, strict=True) if name in wanted]
    found = torch.autograd.grad(outputs, leaves, [d.to(o) for d, o in zip(d_outputs, outputs, strict=True)])
    there = [name for name in NAMES if name in wanted]
    return [o.detach().cpu() for o in outputs], {k: v.cpu() for k, v in zip(there, found, strict=True)}


class BackendScene:
    """A case with its field and rays where the kernels run."""

    def __init__(self, dtype=torch.float32, **sizes):
        self.case = Case(**{"n": 1, "uniform": 2, "importance": 2} | sizes)
        self.leaves = [leaf.to(DEVICE, dtype) for leaf in self.case.leaves]
        self.field, self.rays = self.case.field(self.leaves), self.case.rays(self.leaves)
        self.jitter = self.case.jitter.to(DEVICE, dtype)
        self.reference = self.case.renderer
        self.triton = replace(self.reference, backend="triton")

    def taken_over(self, caplog, why: str, **changes) -> None:
        """The reference's numbers to the bit, and one line that says why, also when asked twice."""
        given = {"field": self.field, "rays": self.rays, "jitter": self.jitter} | changes
        expected = self.reference.render(**given)
        for _ in range(2):
            found = self.triton.render(**given)
            for name in ("rgb", "opacity", "depth"):
                assert torch.equal(getattr(found, name), getattr(expected, name))
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert why in caplog.messages[0]
        assert "reference takes over" in caplog.messages[0]
