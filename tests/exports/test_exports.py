"""Files of a known scene: they show what the field shows, the right way round, in scene units."""

import json
import struct
import sys
from dataclasses import replace

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bars_scene import BALL, BARS, SLAB, STANDS, THICK, BarsOnSlab, bars_scene
from nerfdiff.cameras import Cameras
from nerfdiff.cli import load_config
from nerfdiff.exports.backdrop import Backdrop
from nerfdiff.exports.export import FieldExport, export_fields, field_name
from nerfdiff.exports.views import CameraPath, over, render_rgba
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field, save_field
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError, DataError

SMALL = ["mesh.resolution=64", "path.frames=4", "height=48", "views=2", "points=4000", "mesh.colour_views=6"]


@pytest.fixture(scope="module")
def saved() -> SavedField:
    return bars_scene()


def export_of(saved: SavedField, *overrides: str) -> FieldExport:
    return FieldExport.of(saved, load_config("export", [*SMALL, *overrides]))


@pytest.fixture(scope="module")
def files(saved, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports")
    return {
        path.suffix: path for path in export_of(saved).write(folder, "bars", ["glb", "obj", "ply", "mp4", "gif", "png"])
    }


def srgb(linear):
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def corners_and_colours(path):
    """What trimesh reads of a file, the colours in sRGB."""
    (loaded,) = trimesh.load_scene(path, process=False).geometry.values()
    if path.suffix == ".ply":
        return loaded, np.asarray(loaded.vertices), np.asarray(loaded.colors)[:, :3] / 255
    if path.suffix == ".glb":
        return loaded, np.asarray(loaded.vertices), srgb(loaded.visual.vertex_attributes["color"][:, :3] / 65535)
    return loaded, np.asarray(loaded.vertices), np.asarray(loaded.visual.vertex_colors)[:, :3] / 255


@pytest.mark.parametrize("kind", [".glb", ".obj", ".ply"])
def test_bars_of_known_length_and_colour_lie_along_the_axes_of_the_file(files, kind):
    _, points, colours = corners_and_colours(files[kind])
    for axis, (colour, length) in BARS.items():
        assert points[:, axis].max() == pytest.approx(length, abs=0.02)
        far = points[:, axis] > 0.75 * length
        assert np.abs(np.delete(points[far], axis, 1)).max() < THICK + 0.02
        assert np.abs(np.median(colours[far], 0) - colour).max() < 0.06
    assert points.min() > -0.14  # nothing but the ball on the other side


def test_the_mesh_is_closed_faces_outwards_and_is_of_one_part(files):
    mesh, *_ = corners_and_colours(files[".glb"])
    assert mesh.is_watertight and mesh.volume > 0 and mesh.body_count == 1
    facing = (mesh.face_normals * mesh.vertex_normals[mesh.faces].mean(1)).sum(-1)
    assert (facing > 0).mean() > 0.99


def drawn(points, faces, colours, camera: Cameras, finer: int = 4, count: int = 500_000):
    """RGBA of a mesh in the camera's pixels: points spread over it, the nearest in each of finer pixels, averaged."""
    generator = np.random.default_rng(0)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = generator.choice(len(faces), count, p=area / area.sum())
    weights = generator.dirichlet(np.ones(3), count)[..., None]
    spread, colour = ((values[faces[chosen]] * weights).sum(1) for values in (points, colours))
    fine = camera.resized(camera.height * finer, camera.width * finer)
    pixels, z = (values[0].numpy() for values in fine.project(torch.from_numpy(spread).float()[None]))
    column, row = np.floor(pixels).astype(int).T
    order = np.argsort(-z)
    order = order[(column[order] >= 0) & (column[order] < fine.width) & (row[order] >= 0) & (row[order] < fine.height)]
    picture = np.zeros((fine.height, fine.width, 4))
    picture[row[order], column[order], :3] = colour[order]
    picture[row[order], column[order], 3] = 1
    return picture.reshape(camera.height, finer, camera.width, finer, 4).mean((1, 3))


def from_file(points):
    """Points of a file in the input camera's space, by the convention that docs/exports.md states."""
    front = np.array([0, np.sin(np.pi / 6), -np.cos(np.pi / 6)])
    axes = np.stack([[1, 0, 0], STANDS.up.numpy(), front])
    return points @ axes + STANDS.point.numpy()


@pytest.mark.parametrize(("azimuth", "least"), [(0.0, 25.0), (120.0, 22.0)])
def test_the_mesh_shows_what_the_field_shows(saved, files, azimuth, least):
    mesh, points, colours = corners_and_colours(files[".glb"])
    camera = STANDS.around(saved.field.cameras, torch.tensor([azimuth]), None)
    field = render_rgba(saved, camera, 48)[0].movedim(0, -1).numpy()
    shown = drawn(from_file(points), mesh.faces, colours, camera)
    inside, covered = field[..., 3] > 0.5, shown[..., 3] > 0.5
    assert (inside & covered).sum() > 0.9 * (inside | covered).sum()
    inside = field[..., 3] > 0.95
    error = (shown[..., :3] + 1 - shown[..., 3:] - field[..., :3])[inside & (shown[..., 3] > 0.99)]
    assert -10 * np.log10((error**2).mean()) > least


def test_a_glb_has_linear_colours_that_no_light_changes(files):
    data = files[".glb"].read_bytes()
    tree = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    primitive = tree["meshes"][0]["primitives"][0]
    colour = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (colour["componentType"], colour["type"], colour["normalized"]) == (5123, "VEC4", True)
    assert "KHR_materials_unlit" in tree["materials"][primitive["material"]]["extensions"]
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"] and "NORMAL" in primitive["attributes"]


def test_videos_begin_at_the_input_camera_and_go_all_around(saved, files):
    first = over(render_rgba(saved, saved.field.cameras, 48), 1.0)[0].movedim(0, -1).numpy()
    for kind in (".mp4", ".gif"):
        frames = imageio.mimread(files[kind])
        assert len(frames) == 4
        shown = np.asarray(Image.fromarray(frames[0][..., :3]).resize((64, 48), Image.Resampling.BOX)) / 255
        assert np.abs(shown - first).mean() < 0.02
        assert np.abs(frames[2][..., :3].astype(float) - frames[0][..., :3]).mean() > 2


def test_pictures_keep_what_is_transparent(saved, files):
    pictures = [np.asarray(Image.open(path)) for path in sorted(files[""].iterdir())]
    assert len(pictures) == 2 and pictures[0].shape == (48, 64, 4)
    truth = render_rgba(saved, saved.field.cameras, 48)[0].movedim(0, -1).numpy()
    assert np.abs(pictures[0] / 255 - truth).max() < 0.01
    assert pictures[0][0, 0, 3] == 0 and pictures[0][..., 3].max() == 255
    edge = (truth[..., 3] > 0.2) & (truth[..., 3] < 0.8)  # the scene's own colour, without the white behind it
    assert pictures[0][..., :3][edge].mean(-1).max() < 0.75 * 255


def below_the_ball(export):
    """Heights of a mesh's corners under the ball, as shares of the slab's, and the least channel of each."""
    axes = STANDS.axes(export.source)
    points = (export.surface.points - STANDS.point) @ axes.T
    under = (points[:, [0, 2]].abs() < SLAB[0]).all(1) & (points[:, 1] < -BALL)
    return (-BALL - points[under, 1]) / (2 * SLAB[1]), export.surface.colours[under].amin(1)


def test_what_only_repeats_the_background_is_left_out_of_meshes_and_pictures(tmp_path):
    scene = bars_scene(BarsOnSlab)
    kept, clear = (export_of(scene, *more) for more in (["mesh.backdrop.views=0"], ["mesh.backdrop.own_share=0.5"]))
    depth, least = below_the_ball(kept)
    assert depth.max() > 0.9 and least.max() > 0.95
    depth, least = below_the_ball(clear)
    assert not len(depth) or (depth.max() < 0.5 and least.max() < 0.8)
    # nothing else went: the bars and the ball are those of the scene without a slab
    whole = export_of(bars_scene())
    assert clear.surface.points.amax(0) == pytest.approx(whole.surface.points.amax(0), abs=0.01)
    pictures = [export.clear_frames[0] for export in (kept, clear, whole)]
    assert (pictures[0][3] - pictures[2][3]).abs().max() > 0.9
    assert (pictures[1][3] - pictures[2][3]).abs().mean() < 0.01
    assert torch.allclose(over(pictures[1][None], 1.0), over(pictures[0][None], 1.0), atol=0.01)


def test_an_object_as_light_as_its_background_is_kept_and_named(caplog):
    kept, light = (export_of(bars_scene(BarsOnSlab), *more) for more in (["mesh.backdrop.views=0"], []))
    assert torch.equal(kept.surface.points, light.surface.points)
    assert "as light as the background" in caplog.text


def test_a_large_patch_of_the_background_takes_the_colours_beside_it_and_a_small_one_stays():
    settings = export_of(bars_scene(), "mesh.backdrop.patch=0.2", "mesh.backdrop.rim=0.15").mesh.backdrop
    backdrop = Backdrop(settings, 1.0, bars_scene().field.cameras, torch.zeros(1, 48, 64, dtype=torch.bool))
    n = 20  # a strip of triangles: a red end, two rim corners, a white end with one white corner apart
    points = torch.stack([torch.arange(n) / n, torch.arange(n) % 2 / n, torch.zeros(n)], 1)
    faces = np.stack([np.arange(n - 2), np.arange(1, n - 1), np.arange(2, n)], 1)
    colours = torch.tensor([[0.8, 0.1, 0.1]]).repeat(n, 1)
    colours[3] = 1.0
    colours[10:12] = torch.tensor([0.9, 0.7, 0.7])
    colours[12:] = 1.0
    painted = backdrop.painted_over(points, colours, faces)
    assert torch.equal(painted[:10], colours[:10])
    assert torch.allclose(painted[10:], torch.tensor([0.8, 0.1, 0.1]), atol=1e-6)


def test_pictures_may_be_larger_than_the_models(saved):
    large, small = (render_rgba(saved, saved.field.cameras, height)[0] for height in (96, 48))
    assert large.shape == (4, 96, 128)
    assert (large.reshape(4, 48, 2, 64, 2).mean((2, 4)) - small).abs().mean() < 0.01


def test_paths(saved):
    source = saved.field.cameras
    ahead = CameraPath(8, [-30, 30], None, there_and_back=True).cameras(source, STANDS)
    assert torch.allclose(ahead.c2w[2], ahead.c2w[6], atol=1e-5) and ahead.c2w[2, 0, 3].abs() < 1e-5
    rising = CameraPath(5, [0, 90], [0, 60], there_and_back=False).cameras(source, STANDS)
    heights = (rising.centres - STANDS.point) @ STANDS.up / 1.3
    assert torch.allclose(torch.rad2deg(heights.asin()), torch.tensor([0.0, 15, 30, 45, 60]), atol=1e-3)
    right = STANDS.around(source, torch.tensor([90.0]), torch.tensor([0.0]))
    assert torch.allclose(right.centres[0], torch.tensor([1.3, 0, 1.3]), atol=1e-5)  # anticlockwise from above
    same = STANDS.around(source, torch.zeros(1), None)
    assert torch.allclose(same.c2w, source.c2w, atol=1e-5)


def test_straight_above_the_lower_edge_is_the_front():
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[50.0, 0, 24], [0, 50, 24], [0, 0, 1]]]), 48, 48)
    above = Upright(torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1]))
    level = above.around(camera, torch.zeros(1), torch.zeros(1))
    assert torch.allclose(level.centres[0], torch.tensor([0.0, 1, 1]), atol=1e-6)


def test_a_field_says_how_its_scene_stands(saved, tmp_path, caplog):
    path = tmp_path / "car" / FIELD
    plain = replace(saved, field=saved.field.alone(0))
    for stands, said in ((STANDS, False), (None, True)):
        save_field(path, replace(plain, stands=stands))
        loaded = load_field(path).stands
        assert loaded is None if stands is None else torch.allclose(loaded.up, stands.up)
        caplog.clear()
        with pytest.raises(DataError, match="the field is empty"):  # as it is not fitted
            export_fields(load_config("export", [*SMALL, "format=[ply]", "mesh.density=1000"]), [str(path)])
        assert ("source_elevation" in caplog.text) == said
    assert field_name(path) == "car" and field_name(tmp_path / "van.safetensors") == "van"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["format=[glb,fbx]"], "'fbx'.*glb, obj, ply"),
        (["format=[]"], "expected some of glb"),
        (["path.elevation=90"], r"within \(-90, 90\)"),
        (["path.azimuth=[0]"], "from, to"),
        (["mesh.resolution=4"], "8 to 1024"),
    ],
)
def test_impossible_settings_are_named(saved, tmp_path, overrides, words):
    save_field(tmp_path / FIELD, replace(saved, field=saved.field.alone(0)))
    with pytest.raises(Exception, match=words):
        export_fields(load_config("export", overrides), [str(tmp_path / FIELD)])


def test_without_trimesh_it_says_what_to_install(saved, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ConfigError, match="pip install trimesh"):
        export_of(saved).write(tmp_path, "bars", ["glb"])
    assert not list(tmp_path.iterdir())
