"""Generated copies of ABO and Clevr3D through their own readers, from files to rays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from nerfdiff.cli import load_config
from procedural.generate import make_scenes
from procedural.kinds.choose import scene_kind
from procedural.kinds.kind import SceneJob

CONF = Path(__file__).parents[2] / "conf"
SMALL = {"abo": {"splits.items.scenes": 3, "splits.items.views": 6}, "clevr3d": {"splits.scenes.scenes": 2}}


@pytest.fixture(scope="module", params=["abo", "clevr3d"])
def made(request, tmp_path_factory):
    """(name, what the scenes were made with, their reader)."""
    name, root = request.param, tmp_path_factory.mktemp(request.param)
    small = [f"{key}={value}" for key, value in SMALL[name].items()]
    small += [
        "resolution=48",
        "samples_per_pixel=4",
        "processes=1",
        "variant=scalar_rgb",
        "contact_sheet.enabled=false",
    ]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("make_scenes", [*small, f"scenes={name}", f"root={root / 'data'}"])
    make_scenes(cfg)
    splits = {"abo": "{train:1,val:0,test:0}", "clevr3d": "{train:[0,2]}"}[name]
    key = {"abo": "split_sizes", "clevr3d": "splits"}[name]
    overrides = [f"data={name}", f"data.root={root / 'data'}", f"data.cache_dir={root}", "data.image_size=null"]
    data = instantiate(load_config("train", [*overrides, f"data.reader.{key}={splits}"]).data)
    return name, cfg, data.reader("train")


def known_points(name, cfg, reader, index):
    """Points as the generator's own numbers have them: in its world, and in the one that the reader is to put them in.

    With them, cameras' centres in the generator's world, and the focal length in pixels.
    """
    kind = scene_kind(OmegaConf.to_container(cfg, resolve=True))
    if name == "clevr3d":
        job = SceneJob(Path(cfg.root), "scenes", int(reader.scene_id(index)), 3)
        points = np.array(
            [[o.x, o.y, z] for o in kind.world(job).objects for z in (0, o.half_height, 2 * o.half_height)]
        )
        return points, points, kind.centres(job), 350 / 240 * 48
    jobs = [SceneJob(Path(cfg.root), "items", k, 6) for k in range(3)]
    (job,) = [job for job in jobs if kind.folder(job).name == reader.scene_id(index)]
    model = kind.model(job)
    points = np.concatenate([part.vertices for part in model.parts])[::29]
    low, high = model.bounds()
    centred = (points - (low + high) / 2) / (np.abs(high - low).max() / 2)
    return points, centred, kind.poses(model, 6)[:, :3, 3], 24 / np.tan(np.radians(20))


def test_known_points_lie_on_their_pixels(made):
    name, cfg, reader = made
    for index in range(len(reader)):
        points, expected_world, centres, focal = known_points(name, cfg, reader, index)
        scene = reader.load(index)
        # what cameras look at is the origin of the reader's world
        scale = np.linalg.norm(points[0] - points[-1]) / np.linalg.norm(expected_world[0] - expected_world[-1])
        target = points[0] - scale * expected_world[0]
        pixels, depth = scene.cameras.project(torch.from_numpy(expected_world).float())
        for view, centre in enumerate(centres):
            ahead = (target - centre) / np.linalg.norm(target - centre)
            right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
            x, y, z = np.stack([right, np.cross(ahead, right), ahead]) @ (points - centre).T
            middle = [scene.cameras.width / 2, scene.cameras.height / 2]
            np.testing.assert_allclose(pixels[view], np.stack([focal * x / z, focal * y / z], -1) + middle, atol=1e-3)
            assert (depth[view] > scene.near).all() and (depth[view] < scene.far).all()


def test_depth_reprojects_between_views(made):
    _, _, reader = made
    check = instantiate(load_config("inspect_data", []).checks.depth)
    for index in range(len(reader)):
        scene = reader.load(index, truth=True)
        assert scene.mask.any() and not scene.mask.all()
        assert check(scene).value > 0.92
        upside_down = scene.cameras.c2w * torch.tensor([-1.0, -1, 1, 1])
        assert check(replace(scene, cameras=replace(scene.cameras, c2w=upside_down))).value < 0.9
