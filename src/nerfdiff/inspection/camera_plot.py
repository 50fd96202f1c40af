"""Plot of the cameras: frustums in 3D, as one picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from nerfdiff.cameras import Cameras
from nerfdiff.inspection.camera_checks import turn
from nerfdiff.results.text import figure_text
from nerfdiff.trajectories import look_at_point
from nerfdiff.utils.files import atomic

CAMERA, INPUT, LOOK, UP = "#44546a", "#d6278f", "#a9b4c0", "#e08a00"
WORLD = ("#d62728", "#2ca02c", "#1f5fd0")


@dataclass(frozen=True)
class PlottedCameras:
    """The cameras of a scene, as far as a plot needs them."""

    scene: str
    cameras: Cameras
    views: tuple[str, ...]
    source: int | None

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Point the cameras look at, or their middle where their axes are parallel."""
        cameras = self.cameras.to(torch.float64)
        point = look_at_point(cameras) if len(cameras) > 1 and turn(cameras) > 1 else cameras.centres.mean(0)
        return point.numpy()

    @property
    def scale(self) -> float:
        """Median distance of the cameras from `centre`."""
        distances = (self.cameras.centres.double().numpy() - self.centre).astype(float)
        return float(np.median(np.linalg.norm(distances, axis=1))) or 1.0


def write_camera_plot(
    path: Path, scenes: Sequence[PlottedCameras], title: str, max_frustums: int, frustum_size: float, dpi: int
) -> Path | None:
    """Save the first scene's frustums, in its units, beside all scenes' cameras, each moved and scaled to one.

    Args:
        max_frustums: of the first scene that are drawn, spread evenly; the input view is one of them.
        frustum_size: length of a frustum over the cameras' distance from what they look at.
    """
    if not scenes:
        return None
    figure = Figure(figsize=(15, 7.2), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=13)
    left = figure.add_subplot(1, 2, 1, projection="3d")
    right = figure.add_subplot(1, 2, 2, projection="3d")
    _draw_frustums(left, scenes[0], max_frustums, frustum_size)
    _draw_all(right, scenes)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


def _draw_frustums(axes: Axes3D, scene: PlottedCameras, limit: int, size: float) -> None:
    centre, length = scene.centre, size * scene.scale
    count = len(scene.cameras)
    shown = sorted({*np.linspace(0, count - 1, min(limit, count)).round().astype(int).tolist(), scene.source or 0})
    for view in shown:
        marked = view == scene.source
        colour = INPUT if marked else CAMERA
        corners = _frustum(scene.cameras[view], length)
        apex = scene.cameras[view].centres.double().numpy()
        edges = [(apex, corner) for corner in corners] + list(zip(corners, np.roll(corners, -1, 0), strict=True))
        axes.add_collection3d(Line3DCollection(edges, colors=colour, linewidths=2.2 if marked else 0.9))
        up, forward = -scene.cameras.c2w[view, :3, 1].double().numpy(), scene.cameras.c2w[view, :3, 2].double().numpy()
        top = corners[:2].mean(0)
        axes.quiver(*top, *(up * length * 0.8), color=UP, linewidth=1.2, arrow_length_ratio=0.35)
        reach = forward @ (centre - apex)
        axes.plot(*np.stack([apex, apex + forward * (reach if reach > 0 else length * 3)]).T, color=LOOK, lw=0.4)
    if scene.source is not None:
        axes.plot([], [], color=INPUT, lw=2.2, label=f"input view, {scene.views[scene.source]}")
    axes.scatter(*centre, color="black", marker="x", s=45, zorder=5, label="closest to all optical axes")
    axes.plot([], [], color=CAMERA, label=f"frustums ({len(shown)} of {count} views read)")
    axes.plot([], [], color=UP, label="up in the image (−y)")
    axes.plot([], [], color=LOOK, label="optical axes")
    _world_axes(axes, 0.4 * scene.scale)
    _equal(axes, np.concatenate([scene.cameras.centres.double().numpy(), centre[None], np.zeros((1, 3))]), pad=length)
    axes.set_title(figure_text(f"scene {scene.scene}: in the dataset's world"), fontsize=11)
    axes.legend(loc="upper left", fontsize=8, framealpha=0.8)


def _draw_all(axes: Axes3D, scenes: Sequence[PlottedCameras]) -> None:
    everything = []
    for scene in scenes:
        centres = (scene.cameras.centres.double().numpy() - scene.centre) / scene.scale
        forward = scene.cameras.c2w[:, :3, 2].double().numpy()
        everything.append(centres)
        axes.quiver(*centres.T, *(forward * 0.18).T, color=CAMERA, linewidth=0.6, arrow_length_ratio=0.3, alpha=0.6)
        if scene.source is not None:
            axes.scatter(*centres[scene.source], color=INPUT, s=22, depthshade=False)
    axes.scatter(0, 0, 0, color="black", marker="x", s=45)
    axes.plot([], [], color=CAMERA, label="cameras and where they look")
    if any(scene.source is not None for scene in scenes):
        axes.scatter([], [], color=INPUT, s=22, label="input views")
    _world_axes(axes, 0.4)
    _equal(axes, np.concatenate([*everything, np.zeros((1, 3))]), pad=0.1)
    title = f"{len(scenes)} scenes: what they look at moved to 0, at median distance 1"
    axes.set_title(title if len(scenes) > 1 else "the same, moved and scaled: cameras as arrows", fontsize=11)
    axes.legend(loc="upper left", fontsize=8, framealpha=0.8)


def _frustum(camera: Cameras, length: float) -> Float[np.ndarray, "4 3"]:
    """World positions of the image's corners at depth `length`, clockwise from the top left."""
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
    local = np.linalg.solve(camera.K.double().numpy(), pixels.T).T * length
    c2w = camera.c2w.double().numpy()
    return local @ c2w[:3, :3].T + c2w[:3, 3]


def _world_axes(axes: Axes3D, length: float) -> None:
    for direction, (name, colour) in zip(np.eye(3) * length, zip("xyz", WORLD, strict=True), strict=True):
        axes.quiver(0, 0, 0, *direction, color=colour, linewidth=2.0, arrow_length_ratio=0.15)
        axes.text(*(direction * 1.15), name, color=colour, fontsize=10, fontweight="bold")


def _equal(axes: Axes3D, points: Float[np.ndarray, "n 3"], pad: float) -> None:
    """One scale on all three axes, around the points."""
    low, high = points.min(0) - pad, points.max(0) + pad
    extent = np.maximum(high - low, 0.3 * (high - low).max())  # a flat ring of cameras still gets a box
    middle = (low + high) / 2
    low, high = middle - extent / 2, middle + extent / 2
    for setter, start, end in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low, high, strict=True):
        setter(start, end)
    axes.set_box_aspect(extent, zoom=1.05)
    axes.set(xlabel="x", ylabel="y", zlabel="z")
    axes.tick_params(labelsize=8)
    axes.view_init(elev=22, azim=-55)
