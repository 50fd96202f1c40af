"""Fields to files of other programs, by the settings of `conf/exports`."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import imageio.v2 as imageio
from hydra.utils import instantiate
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from nerfdiff.evaluation.run import SAMPLES, choose_device
from nerfdiff.exports.backdrop import Backdrop
from nerfdiff.exports.models import write_mesh, write_points
from nerfdiff.exports.surface import Surface, SurfaceSettings
from nerfdiff.exports.viewer import write_viewer
from nerfdiff.exports.views import CameraPath, over, render_rgba, to_image
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field
from nerfdiff.inputs import check_formats
from nerfdiff.metrics.image import quantise
from nerfdiff.results.pictures import orbit_video
from nerfdiff.trajectories import Upright
from nerfdiff.utils.config import plain
from nerfdiff.utils.files import atomic

log = logging.getLogger(__name__)


@dataclass
class FieldExport:
    """Write the files of one field. What several of them need is computed once.

    Args:
        stands: how its scene stands.
        height: of pictures, in pixels.
        views: pictures with transparency, of all along the path.
        background: grey level of videos.
        points: of the point cloud.
        viewer: arguments of `write_viewer`.
    """

    saved: SavedField
    stands: Upright
    path: CameraPath
    mesh: SurfaceSettings
    fps: int
    height: int
    views: int
    background: float
    points: int
    viewer: Mapping[str, int]

    @staticmethod
    def of(saved: SavedField, cfg: DictConfig) -> "FieldExport":
        """Take the settings of a composed config of `conf/exports`."""
        samples = {name: cfg[name] for name in SAMPLES if cfg[name] is not None}
        device = choose_device(cfg.device)
        saved = replace(saved, field=saved.field.to(device), renderer=replace(saved.renderer, **samples))
        middle = float(saved.field.near[0] + saved.field.far[0]) / 2
        stands = saved.stands or Upright.assumed(middle, cfg.source_elevation)
        numbers = {name: cfg[name] for name in ("fps", "height", "views", "background", "points")}
        return FieldExport(
            saved, stands, instantiate(cfg.path), instantiate(cfg.mesh), viewer=plain(cfg.viewer), **numbers
        )

    @cached_property
    def source(self):
        """The input camera [1]."""
        return self.saved.field.cameras.to("cpu")

    @cached_property
    def backdrop(self) -> Backdrop | None:
        return self.mesh.backdrop.look(self.saved, self.stands)

    @cached_property
    def surface(self) -> Surface:
        return self.mesh.surface(self.saved, self.stands, self.backdrop)

    @cached_property
    def frames(self) -> Float[Tensor, "frames 4 height _width"]:
        """Pictures along the path, with transparency."""
        cameras = self.path.cameras(self.source, self.stands).to(self.saved.field.K.device)
        return render_rgba(self.saved, cameras, self.height)

    @cached_property
    def clear_frames(self) -> Float[Tensor, "frames 4 height _width"]:
        """The same, `cleared`."""
        return self.cleared(self.frames)

    def cleared(self, rgba: Float[Tensor, "views 4 height width"]) -> Float[Tensor, "views 4 height width"]:
        """Make transparent what only repeats the field's background, where that can be told."""
        return rgba if self.backdrop is None else self.backdrop.cleared(rgba)

    def _filmed(self) -> Float[Tensor, "frames 3 height _width"]:
        own = self.background == self.saved.renderer.background
        return over(self.frames if own else self.clear_frames, self.background)

    def write(self, folder: Path, name: str, formats: Collection[str]) -> list[Path]:
        """Write `<folder>/<name>.<format>` for each format; of png a folder `<name>_views`.

        Raises:
            ConfigError: an unknown format, or one that needs a package that is not installed.
            DataError: the field is empty, or a file cannot be written.
        """
        check_formats(formats)
        return [getattr(self, f"_{kind}")(folder / f"{name}.{kind}") for kind in dict.fromkeys(formats)]

    def _glb(self, path: Path) -> Path:
        return write_mesh(path, self.surface, self.source, self.stands)

    _obj = _glb

    def _ply(self, path: Path) -> Path:
        return write_points(path, self.surface, self.source, self.stands, self.points)

    def _html(self, path: Path) -> Path:
        return write_viewer(path, self.saved, self.stands, path.stem, **self.viewer)

    def _mp4(self, path: Path) -> Path:
        return orbit_video(path, self._filmed(), self.fps)

    def _gif(self, path: Path) -> Path:
        frames = quantise(self._filmed()).permute(0, 2, 3, 1).numpy()
        with atomic(path) as temporary:
            imageio.mimwrite(temporary, list(frames), duration=1000 / self.fps, loop=0)
        return path

    def _png(self, path: Path) -> Path:
        folder = path.with_name(f"{path.stem}_views")
        frames = self.clear_frames
        count = min(self.views, len(frames))
        for number in range(count):
            with atomic(folder / f"{number:02d}.png") as temporary:
                to_image(frames[number * len(frames) // count]).save(temporary)
        return folder


def export_fields(cfg: DictConfig, fields: Sequence[str]) -> list[Path]:
    """Write the files `cfg.format` of fields, beside them or into `cfg.out`; return what was written.

    Raises:
        UserError: something that is no field, settings that cannot be, or a field that is empty.
    """
    check_formats(cfg.format)
    written = []
    for path in map(Path, fields):
        export = FieldExport.of(load_field(path), cfg)
        if export.saved.stands is None:
            log.warning(
                "%s does not say how its scene stands: the camera is taken to look down from %g degrees "
                "(source_elevation)",
                path,
                cfg.source_elevation,
            )
        written += export.write(Path(cfg.out or path.parent), field_name(path), cfg.format)
    return written


def field_name(path: Path) -> str:
    """Return the name of a field's files: the field's own, or its folder's where it is called like all fields."""
    return path.absolute().parent.name if path.name == FIELD else path.stem
