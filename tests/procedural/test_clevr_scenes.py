import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from PIL import Image

from closed_surface import assert_closed
from nerfdiff.utils.errors import ConfigError
from procedural.clevr.objects import COLOURS, place_objects
from procedural.clevr.world import rounded_cylinder
from procedural.generate import make_scenes
from procedural.mesh import Part

CONF = Path(__file__).parents[2] / "conf"
HEIGHT, WIDTH = 36, 48
FOCAL = 350 / 320 * WIDTH


def config(root, *overrides):
    small = [f"resolution={HEIGHT}", "samples_per_pixel=16", "processes=1", "variant=scalar_rgb", "scenes=clevr3d"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("make_scenes", [*small, "splits.scenes.scenes=3", f"root={root}", *overrides])


def files(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "clevr"
    return root, make_scenes(config(root))


def look_at(centre):
    """Right, down and forward of a camera that looks at the origin, up being z; rows."""
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def views(root, scenes=3):
    """Scene, camera position, image, Euclidean depth and labels of every view, as the format is described."""
    metadata = np.load(root / "metadata.npz")
    for s in range(scenes):
        for v in range(3):
            image = np.asarray(Image.open(root / "images" / f"img_{s}_{v}.png").convert("RGB"))
            codes = np.asarray(Image.open(root / "depths" / f"depths_{s}_{v}.png"))
            labels = np.asarray(Image.open(root / "masks" / f"masks_{s}_{v}.png"))
            yield s, metadata["camera_pos"][s, v], image, codes / (65536 * 0.025), labels


def points(centre, depth):
    """World points of all pixels from Euclidean depth."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return centre + depth[..., None] * (rays @ look_at(centre))


def test_files_are_those_of_the_public_set(made):
    root, result = made
    assert result["rendered"] == 9
    assert {p.name for p in (root / "images").iterdir()} == {f"img_{s}_{v}.png" for s in range(3) for v in range(3)}
    metadata = np.load(root / "metadata.npz")
    assert metadata["camera_pos"].shape == (3, 3, 3) and metadata["shape"].shape == (3, 10)
    assert set(metadata) >= {"color", "material", "size", "rotation", "3d_coords"}
    counts = (metadata["shape"] > 0).sum(axis=1)
    assert (counts >= 3).all() and (counts <= 6).all()
    for s in range(3):
        assert (metadata["shape"][s, counts[s] :] == 0).all() and (metadata["shape"][s, : counts[s]] > 0).all()
        assert set(metadata["size"][s, : counts[s]]) <= {0.35, 0.7}
    for s, _, image, depth, labels in views(root):
        assert image.shape == (HEIGHT, WIDTH, 3) and depth.shape == labels.shape == (HEIGHT, WIDTH)
        assert labels.dtype == np.uint8 and labels.max() <= counts[s]
        assert Image.open(root / "depths" / f"depths_{s}_0.png").mode.startswith("I;16")
        # The background is floor, not white, and nothing is black.
        assert image[labels == 0].max() < 250 and image.min() >= 1
        assert depth.min() > 4 and depth.max() <= 40


def test_the_three_cameras_stand_120_degrees_apart_at_their_own_distances(made):
    for centres in np.load(made[0] / "metadata.npz")["camera_pos"]:
        azimuth = np.degrees(np.arctan2(centres[:, 1], centres[:, 0]))
        assert np.allclose((azimuth - azimuth[0]) % 360, [0, 120, 240], atol=1e-9)
        assert len(set(np.linalg.norm(centres, axis=1).round(6))) == 3
        assert np.abs(centres[0] / np.linalg.norm(centres[0]) - np.array([7.2, -6.8, 5.1]) / 11.14).max() < 0.08


def test_depth_of_background_is_the_floor_and_of_objects_their_surface(made):
    metadata = np.load(made[0] / "metadata.npz")
    for s, centre, _, depth, labels in views(made[0]):
        world = points(centre, depth)
        far = depth > 39.9
        # Depth codes are 0.6 mm apart.
        assert np.abs(world[(labels == 0) & ~far][:, 2]).max() < 2e-3
        for k, (shape, size, place) in enumerate(
            zip(metadata["shape"][s], metadata["size"][s], metadata["3d_coords"][s], strict=True), start=1
        ):
            surface = world[labels == k] - place
            if shape == 0:
                assert not len(surface)
            elif shape == 2:
                assert np.allclose(np.linalg.norm(surface, axis=-1), size, atol=2e-3)
            else:
                assert (np.hypot(surface[:, 0], surface[:, 1]) < size + 2e-3).all()
                half = size / np.sqrt(2) if shape == 1 else size
                assert place[2] == pytest.approx(half)
                assert (np.abs(surface[:, 2]) < half + 2e-3).all()


def test_object_centres_project_into_their_masks_to_within_a_pixel(made):
    metadata = np.load(made[0] / "metadata.npz")
    compared = 0
    for s, centre, _, _, labels in views(made[0]):
        axes = look_at(centre)
        for k in np.flatnonzero(metadata["shape"][s] == 2):
            local = axes @ (metadata["3d_coords"][s, k] - centre)
            u, v = FOCAL * local[:2] / local[2] + [WIDTH / 2, HEIGHT / 2]
            radius = FOCAL * metadata["size"][s, k] / local[2]
            rows, columns = np.nonzero(labels == k + 1)
            # Only where nothing hides it or cuts it off: its area is that of the disc.
            if len(rows) < 0.93 * np.pi * radius**2:
                continue
            compared += 1
            assert abs(columns.mean() + 0.5 - u) < 0.75 and abs(rows.mean() + 0.5 - v) < 0.75
    assert compared >= 3


def test_depth_of_one_view_lands_on_the_surface_seen_in_the_others(made):
    everything = list(views(made[0]))
    for a, b in ((0, 1), (1, 2), (2, 0), (3, 5), (7, 6)):
        world = points(everything[a][1], everything[a][3]).reshape(-1, 3)
        labels = everything[a][4].ravel()
        centre = everything[b][1]
        local = (world - centre) @ look_at(centre).T
        u, v = (FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]).T
        inside = (local[:, 2] > 0) & (u > 1) & (u < WIDTH - 1) & (v > 1) & (v < HEIGHT - 1)
        row, column = v[inside].astype(int), u[inside].astype(int)
        there, seen = np.linalg.norm(world[inside] - centre, axis=1), everything[b][3][row, column]
        floor = (labels[inside] == 0) & (everything[b][4][row, column] == 0)
        # Within half a pixel a slanted floor's depth changes by about a pixel's footprint.
        slack = 0.6 * there**2 / FOCAL / centre[2]
        assert inside.sum() > 100
        assert (np.abs(there - seen) < slack)[floor].mean() > 0.99


def test_objects_show_their_colour(made):
    metadata = np.load(made[0] / "metadata.npz")
    compared = 0
    for s, _, image, _, labels in views(made[0]):
        for k in np.flatnonzero(metadata["material"][s] == 1):
            pixels = image[labels == k + 1].astype(float)
            base = np.array(list(COLOURS.values())[metadata["color"][s, k] - 1], float)
            if len(pixels) < 12 or np.ptp(base) < 50:
                continue
            compared += 1
            assert np.corrcoef(pixels.mean(axis=0), base)[0, 1] > 0.9
    assert compared >= 3


def test_two_processes_a_stopped_run_and_more_scenes_keep_the_bytes(made, tmp_path):
    root, _ = made
    again = tmp_path / "clevr"
    shutil.copytree(root, again)
    (again / ".scenes" / "000001.json").unlink()
    (again / "masks" / "masks_1_2.png").unlink()
    result = make_scenes(config(again))
    assert (result["rendered"], result["kept"]) == (3, 2)
    assert files(again) == files(root)
    make_scenes(config(again, "splits.scenes.scenes=4", "contact_sheet.enabled=false", "processes=2"))
    before, after = np.load(root / "metadata.npz"), np.load(again / "metadata.npz")
    assert all(np.array_equal(before[key], after[key][:3]) and len(after[key]) == 4 for key in before)
    changed = {name for name, data in files(root).items() if files(again)[name] != data}
    assert changed <= {"metadata.npz"}
    make_scenes(config(tmp_path / "two", "processes=2"))
    assert files(tmp_path / "two") == files(root)


def test_objects_keep_their_distance_and_every_kind_occurs():
    drawn = [place_objects(np.random.default_rng(seed), (3, 6), 3.0, 0.25) for seed in range(60)]
    for objects in drawn:
        assert 3 <= len(objects) <= 6
        for i, a in enumerate(objects):
            assert max(abs(a.x), abs(a.y)) <= 3
            assert all(np.hypot(a.x - b.x, a.y - b.y) > a.size + b.size + 0.25 for b in objects[:i])
    everything = [o for objects in drawn for o in objects]
    assert {o.shape for o in everything} == {"cube", "sphere", "cylinder"}
    assert {o.material for o in everything} == {"rubber", "metal"}
    assert {o.colour for o in everything} == set(COLOURS) and {o.size for o in everything} == {0.35, 0.7}
    with pytest.raises(ConfigError, match="do not fit"):
        place_objects(np.random.default_rng(0), (6, 6), 0.5, 0.25)


def test_the_cylinder_is_closed_round_and_has_outward_normals():
    vertices, faces, normals = rounded_cylinder(0.7)
    merged, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    part = Part("cylinder", merged, index.reshape(-1)[faces], (0, 0, 0))
    assert_closed(part)
    assert 0.97 * 2 * np.pi * 0.7**3 < part.volume() < 2 * np.pi * 0.7**3
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((flat * normals[faces].mean(axis=1)).sum(axis=1) > 0).all()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("splits.scenes.views=4", "3 views"),
        ("resolution=32", "multiple of 3"),
        ("samples_per_pixel=6", "multiple of 4"),
        ("scenes.objects=[3,11]", "from 1 to 10"),
        ("scenes.objects=[5,3]", "ascending"),
        ("scenes.camera=[7.2,-6.8,3.0]", "horizon"),
        ("scenes.camera=[7.2,-6.8]", "three numbers"),
        ("scenes.objects=[few,6]", "from 1 to 10"),
        ("scenes.gap=-1", "at least 0"),
        ("+splits.train={scenes: 1, views: 3}", "one pool"),
    ],
)
def test_impossible_values_are_refused_before_anything_is_written(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        make_scenes(config(tmp_path / "none", override))
    assert not (tmp_path / "none").exists()


def test_facts_that_cannot_be_read_are_named(made, tmp_path):
    shutil.copytree(made[0], tmp_path / "clevr")
    (tmp_path / "clevr" / ".scenes" / "000002.json").write_text("{")
    with pytest.raises(ValueError, match=r"000002\.json"):
        make_scenes(config(tmp_path / "clevr"))
    assert json.loads((made[0] / ".scenes" / "000002.json").read_text())["objects"]
