"""One picture of several fields side by side, from a camera that all share."""

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.exports.views import over, render_maps, to_image
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.results.pictures import colour_depth
from nerfdiff.trajectories import Upright

SHOWN = ("colour", "depth", "opacity")
INPUT_CAMERA = 0.2
"""Length of the input camera that is drawn, over its distance from what it looks at."""
INK = (210, 60, 40)


@dataclass(frozen=True)
class Pose:
    """A camera in the space of exported files: y up, z to the input camera's side, the scene in the middle.

    Args:
        c2w: camera-to-world, OpenCV axes.
        fov: radians, of the smaller side of a pane.
    """

    c2w: Float[Tensor, "4 4"]
    fov: float


@dataclass(frozen=True)
class Pane:
    """A field, and fields from on the way to it.

    Args:
        name: written above it.
        saved: the field.
        steps: by how many steps of distillation had been done.
        stands: how the scene stands.
    """

    name: str
    saved: SavedField
    steps: Mapping[int, SavedField]
    stands: Upright

    def at(self, done: int | None) -> tuple[str, SavedField]:
        """Return the last field that was kept by then, and what to call it; None: the field itself."""
        known = sorted(self.steps)
        if done is None or not known:
            return self.name, self.saved
        number = known[max(0, bisect.bisect_right(known, done) - 1)]
        return f"{self.name}, step {number}", self.steps[number]

    def pose(self) -> Pose:
        """Return the input camera."""
        source = self.saved.field.cameras.to("cpu")
        axes, c2w = self.stands.axes(source), torch.eye(4)
        c2w[:3, :3] = axes @ source.c2w[0, :3, :3]
        c2w[:3, 3] = axes @ (source.centres[0] - self.stands.point)
        size = min(source.height, source.width)
        return Pose(c2w, 2 * math.atan(size / 2 / float(source.K[0, 0, 0])))

    def camera(self, pose: Pose, height: int, width: int) -> Cameras:
        """Return a camera [1] of that size in the field's own space."""
        axes, c2w = self.stands.axes(self.saved.field.cameras.to("cpu")), torch.eye(4)
        c2w[:3, :3] = axes.T @ pose.c2w[:3, :3]
        c2w[:3, 3] = axes.T @ pose.c2w[:3, 3] + self.stands.point
        focal = min(height, width) / 2 / math.tan(pose.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Cameras(c2w[None], K[None], height, width)

    def bounds(self, camera: Cameras) -> tuple[float, float]:
        """Return near and far for a camera: from as far as the input camera, the input camera's."""
        near, far = float(self.saved.field.near[0]), float(self.saved.field.far[0])
        moved = float((camera.centres[0] - self.stands.point).norm() - self.stands.point.norm())
        return max(1e-3, near + moved), max(2e-3, far + moved)


@dataclass(frozen=True)
class Look:
    """What of fields is shown, and how.

    Args:
        shown: one of `SHOWN`.
        done: steps of distillation; None: all.
        uniform_samples, importance_samples: per ray.
        input_camera: draw where the input was taken from.
        background: grey level.
    """

    shown: str
    done: int | None
    uniform_samples: int
    importance_samples: int
    input_camera: bool
    background: float


def places(count: int, height: int, width: int) -> list[tuple[int, int, int, int]]:
    """Divide a picture into as many equal panes (left, top, width, height), as square as they can be."""
    columns = max(range(1, count + 1), key=lambda n: min(width / n, height / math.ceil(count / n)))
    rows = math.ceil(count / columns)
    w, h = max(1, width // columns), max(1, height // rows)
    return [(number % columns * w, number // columns * h, w, h) for number in range(count)]


def side_by_side(
    panes: Sequence[Pane],
    pose: Pose,
    look: Look,
    size: tuple[int, int],
    rendered: int,
    unwanted: Callable[[], bool] = lambda: False,
) -> Image.Image | None:
    """Show fields from one camera.

    Args:
        size: height and width of the picture.
        rendered: pixels of a pane's smaller side that are rendered; what lies between is interpolated.
        unwanted: asked now and then; where it is true, the picture is left and None returned.
    """
    grey = round(255 * look.background)
    picture = Image.new("RGB", (size[1], size[0]), (grey, grey, grey))
    for pane, (left, top, width, height) in zip(panes, places(len(panes), *size), strict=True):
        name, saved = pane.at(look.done)
        renderer = replace(
            saved.renderer, uniform_samples=look.uniform_samples, importance_samples=look.importance_samples
        )
        share = min(1.0, rendered / min(height, width))
        camera = pane.camera(pose, max(1, round(height * share)), max(1, round(width * share)))
        near, far = pane.bounds(camera)
        maps = render_maps(replace(saved, renderer=renderer), camera.to(saved.field.K.device), near, far, unwanted)
        if maps is None:
            return None
        image = to_image(_shown(maps, look, near, far)).resize((width, height), Image.Resampling.BICUBIC)
        ink = ImageDraw.Draw(image)
        if look.input_camera:
            _draw_input_camera(ink, pane, pane.camera(pose, height, width), maps)
        if len(panes) > 1 or look.done is not None:
            size_of_text = max(11, min(18, height // 16))
            ink.text((8, 6), name, (128, 128, 128), ImageFont.load_default(size=size_of_text))
        picture.paste(image, (left, top))
    return picture


def _shown(maps: Float[Tensor, "5 h w"], look: Look, near: float, far: float) -> Float[Tensor, "3 h w"]:
    if look.shown == "opacity":
        return maps[3:4].expand(3, -1, -1)
    if look.shown == "depth":
        return colour_depth(maps[4:5], near, far, maps[3:4])[0]
    return over(maps[None, :4], look.background)[0]


def _draw_input_camera(ink: ImageDraw.ImageDraw, pane: Pane, camera: Cameras, maps: Float[Tensor, "5 h w"]) -> None:
    """Draw the pyramid of the input camera, where the scene does not hide it."""
    source = pane.saved.field.cameras.to("cpu")
    depth = INPUT_CAMERA * float(pane.stands.point.norm())
    if float(camera.centres[0].norm()) < depth:  # from within
        return
    inverse = torch.linalg.inv(source.K[0])
    corners = torch.tensor([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    corners = corners * torch.tensor([source.width, source.height, 1.0]) @ inverse.T * depth
    apex = torch.zeros(1, 3)
    starts = torch.cat([apex.expand(4, 3), corners])
    ends = torch.cat([corners, corners.roll(-1, 0)])
    share = torch.linspace(0, 1, 33)[:, None, None]
    points = starts + share * (ends - starts)  # [points, lines, 3]
    pixels, z = camera.project(points.flatten(0, 1)[None])
    distance = (points.flatten(0, 1) - camera.centres[0]).norm(dim=-1)
    where = 2 * pixels[0] / torch.tensor([camera.width, camera.height]) - 1
    behind = F.grid_sample(maps[None, 3:], where[None, None], mode="nearest", align_corners=False)[0, :, 0]
    hidden = (where.abs() <= 1).all(-1) & (behind[0] > 0.5) & (behind[1] < distance)
    good = ((z[0] > 0.02) & ~hidden).reshape(points.shape[:2])
    pixels = pixels[0].reshape(*points.shape[:2], 2)
    for line in range(points.shape[1]):
        for a in range(len(points) - 1):
            if good[a, line] and good[a + 1, line]:
                ink.line([tuple(pixels[a, line].tolist()), tuple(pixels[a + 1, line].tolist())], INK, 2)
