"""A scene that nothing mirrors or turns unnoticed: a grey ball, with bars of other lengths and colours on its axes."""

import torch

from model_fixtures import input_cameras, model
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.render.renderer import Renderer
from nerfdiff.trajectories import Upright

STANDS = Upright.assumed(1.3, 30.0)
BARS = {0: ((0.9, 0.1, 0.1), 0.36), 1: ((0.1, 0.8, 0.1), 0.28), 2: ((0.1, 0.2, 0.9), 0.2)}
"""Along x (right), y (up) and z (to the front): colour and length."""
SLAB = (0.16, 0.04, 0.16)
"""Half sizes of a white slab under the ball, which only before another background can be seen."""
THICK, BALL, SHARP = 0.05, 0.12, 60.0


class BarsOnSlab(RefinedField):
    """The scene on a slab."""

    def field(self):
        return lambda points, directions=None: bars(points, directions, slab=True)


class Bars(RefinedField):
    """The scene, as a field in the space of a camera that looks down at it from 30 degrees."""

    def field(self):
        return bars


def bars(points, directions=None, slab=False):
    # written out: to the right, up, and to the front as the camera at 30 degrees has them
    angle = torch.tensor(30.0).deg2rad()
    up = torch.stack([torch.zeros(()), -angle.cos(), -angle.sin()])
    front = torch.stack([torch.zeros(()), angle.sin(), -angle.cos()])
    axes = torch.stack([torch.tensor([1.0, 0, 0]), up, front])
    local = (points - torch.tensor([0.0, 0, 1.3])) @ axes.T
    inside = [BALL - local.norm(dim=-1)]
    colours = [torch.tensor([0.5, 0.5, 0.5])]
    for axis, (colour, length) in BARS.items():
        along = local[..., axis]
        across = local.abs().clone()
        across[..., axis] = 0
        inside.append(torch.minimum(torch.minimum(along, length - along), THICK - across.amax(-1)))
        colours.append(torch.tensor(colour))
    if slab:
        below = local + torch.tensor([0.0, BALL + SLAB[1], 0.0])
        inside.append((torch.tensor(SLAB) - below.abs()).amin(-1))
        colours.append(torch.ones(3))
    depth, part = torch.stack(inside, -1).max(-1)
    return torch.stack(colours)[part], 150 * torch.sigmoid(SHARP * 4 * depth)


def bars_scene(kind: type[RefinedField] = Bars) -> SavedField:
    """The scene from an input camera with 48 x 64 pixels."""
    net, source = model().requires_grad_(False), input_cameras(1, 48, 64)
    triplane = Triplane(torch.zeros(1, 3, 8, 4, 4), source, torch.tensor([0.8]), torch.tensor([1.8]))
    return SavedField(kind(triplane, net.decoder), Renderer(48, 16, 1.0, 10**6), STANDS)
