import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image

from nerfdiff.utils.errors import ConfigError
from procedural.generate import make_scenes
from procedural.kinds.abo import directions, item_id
from procedural.kinds.choose import scene_kind
from procedural.kinds.kind import SceneJob

CONF = Path(__file__).parents[2] / "conf"
SIZE = 32


def config(root, *overrides):
    small = [f"resolution={SIZE}", "samples_per_pixel=4", "processes=1", "variant=scalar_rgb", "scenes=abo"]
    small += ["splits.items.scenes=3", "splits.items.views=5"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("make_scenes", [*small, f"root={root}", *overrides])


def files(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "abo"
    return root, make_scenes(config(root))


def items(root):
    return sorted(p.parent for p in root.glob("*/transforms.json"))


def frames(item):
    """Images, depths and OpenGL cam2worlds of an item, read as the public description says."""
    data = json.loads((item / "transforms.json").read_text())
    for frame in data["frames"]:
        name = Path(frame["file_path"]).name
        image = np.asarray(Image.open(item / f"{name}.png"))
        depth = np.load(item / "depth" / f"{name}.npz")["depth"]
        yield image, depth, np.array(frame["transform_matrix"]), frame["camera"]


def unproject(depth, c2w, focal):
    """World points of the pixels that hit, with axes x right, y up, z backwards."""
    v, u = np.nonzero(depth)
    z = depth[v, u].astype(np.float64)
    local = np.stack([(u + 0.5 - SIZE / 2) / focal * z, -(v + 0.5 - SIZE / 2) / focal * z, -z], axis=-1)
    return local @ c2w[:3, :3].T + c2w[:3, 3]


def project(points, c2w, focal):
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    z = -local[:, 2]
    return np.stack([focal * local[:, 0] / z, -focal * local[:, 1] / z], axis=-1) + SIZE / 2, z


def test_files_are_those_of_the_public_renders(made):
    root, result = made
    assert result["rendered"] == 15 and len(items(root)) == 3
    for item in items(root):
        assert len(item.name) == 10 and item.name.startswith("B07") and item.name.isalnum()
        data = json.loads((item / "transforms.json").read_text())
        assert list(data) == ["obj_path", "frames"]
        assert item.name in data["obj_path"]
        for k, frame in enumerate(data["frames"]):
            assert list(frame) == ["file_path", "transform_matrix", "camera"]
            assert frame["file_path"].startswith("/") and frame["file_path"].endswith(f"/{item.name}_{k:02d}")
            assert (item / f"{item.name}_{k:02d}.png").exists()
        assert {p.name for p in item.iterdir()} - {f"{item.name}_{k:02d}.png" for k in range(5)} == {
            "depth",
            "scene.json",
            "transforms.json",
        }
        for image, depth, c2w, camera in frames(item):
            assert image.shape == (SIZE, SIZE, 4) and image.dtype == np.uint8
            assert depth.shape == (SIZE, SIZE) and depth.dtype == np.float32
            assert np.array_equal(c2w, c2w.astype(np.float32))
            angles = {camera.pop("angle_x"), camera.pop("angle_y")}
            assert np.degrees(angles.pop()) == pytest.approx(40, abs=1e-5) and not angles
            assert camera == {
                "shift_x": 0.0,
                "shift_y": 0.0,
                "sensor_height": 36.0,
                "sensor_width": 36.0,
                "sensor_fit": "HORIZONTAL",
            }
            # Alpha is coverage: full where the object fills a pixel, none away from it.
            alpha, hit = image[..., 3], depth > 0
            assert (alpha[hit] > 0).all() and (alpha[hit] == 255).mean() > 0.3
            assert (image[alpha == 0] == 0).all() and (alpha == 0).mean() > 0.3


def test_cameras_orbit_the_objects_centre_from_the_same_directions_at_the_public_distance(made):
    root, _ = made
    seen = []
    for item in items(root):
        c2w = np.array([m for _, _, m, _ in frames(item)])
        centres, forward = c2w[:, :3, 3], -c2w[:, :3, 2]
        # Least-squares intersection of the optical axes.
        across = np.eye(3) - forward[:, :, None] * forward[:, None]
        point = np.linalg.solve(across.sum(0), (across @ centres[..., None]).sum(0))[:, 0]
        arms = centres - point
        distance = np.linalg.norm(arms, axis=1)
        assert np.ptp(distance) < 1e-5 * distance[0]
        assert np.linalg.norm(point) > 0.01
        assert (c2w[:, 2, 1] > 0).all()  # y points up
        assert np.abs(np.cross(arms, forward)).max() < 1e-5
        focal = SIZE / 2 / np.tan(np.radians(20))
        points = np.concatenate([unproject(depth, m, focal) for _, depth, m, _ in frames(item)])
        extent = np.abs(points - point).max()
        # Seen pixels stop a little short of the outermost corner.
        assert 0.85 * distance[0] / 4.9455 < extent < 1.001 * distance[0] / 4.9455
        seen.append(arms / distance[:, None])
    assert np.abs(np.diff(seen, axis=0)).max() < 1e-5
    assert np.abs(seen[0] - directions()[:5]).max() < 1e-5


def test_depth_of_one_view_lands_on_the_surface_seen_in_the_others(made):
    root, _ = made
    focal = SIZE / 2 / np.tan(np.radians(20))

    def agreement(misread):
        fits = []
        for item in items(root):
            views = [(depth, c2w @ misread) for _, depth, c2w, _ in frames(item)]
            for a, b in ((0, 1), (1, 0), (3, 4), (2, 1)):
                pixels, z = project(unproject(*views[a], focal), views[b][1], focal)
                column, row = np.floor(pixels).astype(int).clip(0, SIZE - 1).T
                steps = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
                around = np.stack([np.roll(views[b][0], step, axis=(0, 1)) for step in steps])[:, row, column]
                nearest = np.where(around > 0, around, np.inf).min(axis=0)
                # Within the other view's silhouette, to a pixel, and there at or behind what is seen.
                fits.append(z > 0.99 * nearest)
        return np.concatenate(fits).mean()

    assert agreement(np.eye(4)) > 0.97
    # A mirrored image or OpenCV's axes would not fit.
    assert agreement(np.diag([-1.0, 1, 1, 1])) < 0.87
    assert agreement(np.diag([1.0, -1, -1, 1])) < 0.1


def nearest_hit(origin, rays, triangles):
    """Naive ray casting (Möller and Trumbore) in double precision: distance in units of `rays`, inf for none."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(rays[:, None], e2[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (p * e1).sum(-1)
        t = origin - a
        u = (p * t).sum(-1) * inverse
        q = np.cross(t, e1)
        v = (rays @ q.T) * inverse
        distance = (q * e2).sum(-1) * inverse
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return np.where(hit, distance, np.inf).min(axis=1)


def test_rays_through_pixel_centres_meet_the_model_where_depth_says(made):
    root, _ = made
    kind = scene_kind(OmegaConf.to_container(config(root), resolve=True))
    model = kind.model(SceneJob(root, "items", 1, 5))
    triangles = np.concatenate([part.vertices[part.faces] for part in model.parts])
    focal = SIZE / 2 / np.tan(np.radians(20))
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5).reshape(2, -1)
    local = np.stack([(u - SIZE / 2) / focal, -(v - SIZE / 2) / focal, -np.ones_like(u)], axis=-1)
    for _, depth, c2w, _ in list(frames(root / item_id(0, 1)))[:3]:
        expected = nearest_hit(c2w[:3, 3], local @ c2w[:3, :3].T, triangles).reshape(SIZE, SIZE)
        hit = np.isfinite(expected)
        assert (hit == (depth > 0)).mean() > 0.998 and hit.sum() > 40
        both = hit & (depth > 0)
        error = np.abs(depth - expected)[both] / expected[both]
        # Single precision; on an edge the neighbouring surface may be met.
        assert np.quantile(error, 0.98) < 1e-5


def test_directions_follow_the_public_script_and_stay_above_ten_degrees_below_the_horizon():
    d = directions()
    assert d.shape == (30, 3) and np.allclose(np.linalg.norm(d, axis=1), 1)
    assert np.degrees(np.arcsin(d[:, 2])).min() > -10 and d[:, 2].max() > 0.8
    # Blender's Euler angles: the camera (0, 0, 1) is turned about x, then about z.
    rng = np.random.default_rng(0xAAAAAAAAAAAAAAAA)
    u = rng.uniform(0, 1, size=3) * ((np.cos(np.radians(100)) - 1), 0, 2 * np.pi)
    x, z = np.arccos(u[0] + 1), u[2]
    turn_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    turn_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    assert np.allclose(turn_z @ turn_x @ [0, 0, 1], d[0])


def test_item_ids_differ_for_every_index_and_seed():
    ids = [item_id(seed, index) for seed in (0, 1) for index in range(4000)]
    assert len(set(ids)) == 8000 and {len(i) for i in ids} == {10}


def test_two_processes_and_a_stopped_run_give_the_same_bytes(made, tmp_path):
    root, _ = made
    again = tmp_path / "abo"
    shutil.copytree(root, again)
    shutil.rmtree(items(again)[1])
    (again / ".partial" / f"abo-{items(root)[1].name}-1").mkdir(parents=True)
    result = make_scenes(config(again))
    assert (result["rendered"], result["kept"]) == (5, 2)
    assert files(again) == files(root)
    make_scenes(config(tmp_path / "two", "processes=2"))
    assert files(tmp_path / "two") == files(root)


def test_sixteen_bits_hold_the_same_colours_more_finely(made, tmp_path):
    root, _ = made
    make_scenes(config(tmp_path, "scenes.bits=16", "splits.items.scenes=1", "splits.items.views=1"))
    (item,) = items(tmp_path)
    data = (item / f"{item.name}_00.png").read_bytes()
    # The PNG header: bit depth 16, colour type 6 (RGBA).
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and data[24:26] == bytes([16, 6])
    # Pillow keeps the upper 8 of 16 bits.
    coarse = np.asarray(Image.open(item / f"{item.name}_00.png")).astype(int)
    eight = np.asarray(Image.open(root / item.name / f"{item.name}_00.png")).astype(int)
    assert np.abs(coarse - eight).max() <= 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("splits.items.views=31", "30 directions"),
        ("+splits.train={scenes: 1, views: 1}", "one pool"),
        ("scenes.bits=12", "8 or 16"),
        ("+scenes.styles.spoon=1", "spoon.*lamp"),
    ],
)
def test_impossible_values_are_refused_before_anything_is_written(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        make_scenes(config(tmp_path / "none", override))
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("override", ["scenes.bits=16", "scenes.styles.lamp=9", "splits.items.views=6"])
def test_other_parameters_are_refused(made, override):
    with pytest.raises(ConfigError, match="made with other parameters"):
        make_scenes(config(made[0], override))
