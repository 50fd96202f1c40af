"""Random triplane fields and rays, rendered by the kernels and by the float64 reference."""

from dataclasses import dataclass

import torch

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.arguments import Settings
from nerfdiff.render.kernels.function import fused_render
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import KEPT

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
NAMES = ("planes", "w1", "b1", "w2", "b2", "origins", "directions")
IMAGE = 18, 14  # width, height

LAUNCHES = passes._coarse, passes._composite, passes._gradient


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

    def reference(self, dtype=torch.float64) -> tuple[list[torch.Tensor], dict[str, torch.Tensor]]:
        """Outputs and gradients by the PyTorch renderer, on the CPU."""
        leaves = [leaf.to(dtype).requires_grad_() for leaf in self.leaves]
        field = self.field(leaves)
        decoder = (field.decoder.hidden.weight, field.decoder.hidden.bias)
        leaves[1:5] = *decoder, field.decoder.output.weight, field.decoder.output.bias
        jitter = None if self.jitter is None else self.jitter.to(dtype)
        out = self.renderer.render(field, self.rays(leaves), jitter, self.coarse)
        return _with_gradients([out.rgb, out.opacity, out.depth], leaves, self.d_outputs)

    def settings(self, precision: str = "ieee", ordered: bool = False, points: int = 10**6) -> Settings:
        samples = self.uniform, self.importance, self.background
        return Settings(*samples, points, points, precision, ordered, *IMAGE, self.shift, self.scale)

    def render(self, leaves, settings: Settings, keep_coarse: bool = False):
        """Colour, opacity and depth by the kernels for these leaves; and coarse weights where they are to be kept."""
        fixed = (self.K, self.near, self.far, self.ray_near, self.ray_far, self.jitter, self.coarse)
        there = (None if t is None else t.to(DEVICE) for t in fixed)
        outputs = fused_render(settings, _no_recovery, keep_coarse, *leaves, *there)
        return outputs if keep_coarse else outputs[:3]

    def fused(self, **settings) -> tuple[list[torch.Tensor], dict[str, torch.Tensor]]:
        """Outputs and gradients by the kernels."""
        leaves = [leaf.to(DEVICE).requires_grad_() for leaf in self.leaves]
        outputs = self.render(leaves, self.settings(**settings))
        return _with_gradients(outputs, leaves, self.d_outputs)


def _no_recovery(error, *_):
    raise error


def _with_gradients(outputs, leaves, d_outputs):
    found = torch.autograd.grad(outputs, leaves, [d.to(o) for d, o in zip(d_outputs, outputs, strict=True)])
    return [o.detach().cpu() for o in outputs], {k: v.cpu() for k, v in zip(NAMES, found, strict=True)}
