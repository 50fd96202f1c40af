"""Renderings of a field from paths of cameras, with transparency."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError

RAYS = 4096
"""Rendered at once, between two looks whether the picture is still wanted."""


@dataclass(frozen=True)
class CameraPath:
    """A way of the camera around the scene, at the input camera's distance.

    Args:
        frames: on the way.
        azimuth: degrees from and to, anticlockwise seen from above; 0 is the input camera's.
        elevation: degrees above the horizon, one number or from and to; None: the input camera's.
        there_and_back: end where it began, turning back half way.

    Raises:
        ConfigError: values that no path has.
    """

    frames: int
    azimuth: Sequence[float]
    elevation: float | Sequence[float] | None
    there_and_back: bool

    def __post_init__(self):
        elevations = [] if self.elevation is None else self._ends(self.elevation)
        if self.frames < 1 or len(self.azimuth) != 2 or len(elevations) not in (0, 2):
            raise ConfigError(
                f"path: frames={self.frames} must be at least 1, azimuth={list(self.azimuth)} be [from, to], "
                f"elevation={self.elevation} one number, [from, to] or null"
            )
        if not all(-90 < degrees < 90 for degrees in elevations):
            raise ConfigError(f"path.elevation={self.elevation}: expected degrees within (-90, 90)")

    @staticmethod
    def _ends(elevation: float | Sequence[float]) -> list[float]:
        return [elevation, elevation] if isinstance(elevation, int | float) else list(elevation)

    def cameras(self, source: Cameras, stands: Upright) -> Cameras:
        """The path's cameras [frames], in the input camera's space; a full turn does not repeat its first frame."""
        step = torch.arange(self.frames, device=source.K.device)
        start, end = self.azimuth
        level = self.elevation is None or len(set(self._ends(self.elevation))) == 1
        if self.there_and_back:
            share = (1 - (step / self.frames * 2 * torch.pi).cos()) / 2
        elif level and (end - start) % 360 == 0:
            share = step / self.frames
        else:
            share = step / max(1, self.frames - 1)
        elevation = None
        if self.elevation is not None:
            low, high = self._ends(self.elevation)
            elevation = low + share * (high - low)
        return stands.around(source, start + share * (end - start), elevation)


@torch.no_grad()
def render_rgba(saved: SavedField, cameras: Cameras, height: int) -> Float[Tensor, "views 4 height _width"]:
    """Colours of the scene alone and its opacity, in [0, 1], of cameras [views], one after the other.

    Args:
        height: of the pictures; their width follows from the cameras' aspect ratio.
    """
    cameras = cameras.resized(height, max(1, round(height * cameras.width / cameras.height)))
    near, far = float(saved.field.near[0]), float(saved.field.far[0])
    pictures = [render_maps(saved, cameras[view : view + 1], near, far) for view in range(len(cameras))]
    return torch.stack([picture[:4] for picture in pictures if picture is not None])


@torch.no_grad()
def render_maps(
    saved: SavedField, camera: Cameras, near: float, far: float, unwanted: Callable[[], bool] = lambda: False
) -> Float[Tensor, "5 height width"] | None:
    """Colour of the scene alone, opacity, and distance along the ray of a camera [1], on the CPU.

    Args:
        near, far: bounds of the rays, in scene units.
        unwanted: asked now and then; where it is true, the picture is left and None returned.
    """
    there = _somewhere_near(saved, camera, near, far)
    rays = camera[0].rays(near, far)
    chosen = [part[there].split(RAYS) for part in (rays.origins, rays.directions, rays.near, rays.far)]
    picture = torch.zeros(5, *there.shape)
    picture[4] = far
    parts = []
    for part in zip(*chosen, strict=True):
        if unwanted():
            return None
        rgb, alpha, distance = render_rays(saved, Rays(*part))
        parts.append(torch.cat([rgb, alpha[:, None], distance[:, None]], 1).cpu())
    picture[:, there.cpu()] = torch.cat(parts).T if parts else torch.zeros(5, 0)
    return picture


def _somewhere_near(saved: SavedField, camera: Cameras, near: float, far: float) -> Bool[Tensor, "height width"]:
    """Where a small picture of a camera [1], as large as the input's, shows anything, or beside that."""
    small = saved.field.cameras
    if saved.renderer.background is None or camera.height < 2 * small.height or camera.width < 2 * small.width:
        return torch.ones(camera.height, camera.width, dtype=torch.bool, device=camera.K.device)
    bounds = (torch.full_like(saved.field.near, value) for value in (near, far))
    cameras = camera.resized(small.height, small.width)[None]
    opacity = saved.renderer.render_views(saved.field.field(), cameras, *bounds).opacity[0]
    beside = F.max_pool2d(opacity, 3, 1, padding=1)
    return F.interpolate(beside[None], size=(camera.height, camera.width))[0, 0] > 1 / 255


@torch.no_grad()
def render_rays(saved: SavedField, rays: Rays) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Colours of the scene alone, its opacity and its distance along rays [n]."""
    batch = Rays(*(part[None] for part in (rays.origins, rays.directions, rays.near, rays.far)))
    out = saved.renderer.render(saved.field.field(), batch)
    rgb, alpha = own_colour(out.rgb[0], out.opacity[0], saved.renderer.background)
    return rgb, alpha, out.depth[0]


def own_colour(
    composited: Float[Tensor, "*pixels 3"], opacity: Float[Tensor, "*pixels"], background: float | None
) -> tuple[Float[Tensor, "*pixels 3"], Float[Tensor, "*pixels"]]:
    """The colour without the background that shows through, in [0, 1], and the opacity."""
    alpha = opacity.clamp(0, 1)
    if background is None:
        return composited.clamp(0, 1), torch.ones_like(alpha)
    behind = (1 - alpha)[..., None] * background
    return ((composited - behind) / alpha[..., None].clamp_min(1 / 255)).clamp(0, 1), alpha


def over(rgba: Float[Tensor, "views 4 h w"], grey: float) -> Float[Tensor, "views 3 h w"]:
    """Put pictures on a background of one grey level."""
    alpha = rgba[:, 3:]
    return rgba[:, :3] * alpha + (1 - alpha) * grey


def to_image(rgba: Float[Tensor, "channels h w"]) -> Image.Image:
    """A picture of 8 bits, of colours alone or with opacity."""
    pixels = (rgba.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0)
    return Image.fromarray(pixels.contiguous().numpy())
