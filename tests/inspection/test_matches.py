from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from solids import with_poses

from data_fixtures import camera_pose
from nerfdiff.cameras import Cameras
from nerfdiff.cli import load_config
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Status, check_scene
from nerfdiff.inspection.matches import reprojection_error

CHECKS = {n: instantiate(c) for n, c in load_config("inspect_data", ["data.background=null"]).checks.items()}
SIZE, F = 120, 150.0


def wall_scene() -> Scene:
    """Cameras 12° apart before a textured sphere that fills the images: no depth, no mask, no background."""
    rng = np.random.default_rng(0)
    directions, phases = rng.normal(size=(60, 3)) * 45, rng.uniform(0, 6.28, 60)
    poses = np.stack([camera_pose(azimuth, elevation) for azimuth in (0, 0.2, 0.4) for elevation in (0.1, 0.3)])
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    local = np.stack([(u - SIZE / 2) / F, (v - SIZE / 2) / F, np.ones_like(u)], -1)
    images = []
    for pose in poses:
        rays, origin = local @ pose[:3, :3].T, pose[:3, 3]
        a, b = (rays**2).sum(-1), rays @ origin
        t = (-b - np.sqrt(b**2 - a * (origin @ origin - 0.7**2))) / a
        points = origin + rays * t[..., None]
        grey = np.sin(points @ directions.T + phases).mean(-1) * 3
        images.append(np.clip(127 + 127 * grey, 0, 255).astype(np.uint8))
    pixels = torch.from_numpy(np.stack(images))[:, None].expand(-1, 3, -1, -1).contiguous()
    K = torch.tensor([[F, 0, SIZE / 2], [0, F, SIZE / 2], [0, 0, 1]]).expand(len(poses), 3, 3)
    cameras = Cameras(torch.from_numpy(poses).float(), K, SIZE, SIZE)
    return Scene("wall", tuple(map(str, range(len(poses)))), pixels, cameras, near=0.4, far=1.8)


WALL = wall_scene()


def test_matches_confirm_right_cameras_where_nothing_else_can():
    findings = check_scene(WALL, CHECKS)
    assert findings["depth"].status is findings["silhouettes"].status is Status.UNCHECKED
    assert findings["matches"].status is Status.OK and findings["matches"].value > 0.9


@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1)])
def test_matches_refute_wrong_axes(signs):
    finding = CHECKS["matches"](with_poses(WALL, lambda pose: pose @ np.diag([*signs, 1.0])))
    assert finding.status is Status.FAILED and finding.value < 0.3


def test_matches_refute_world_to_camera():
    def shifted(pose):  # a world whose origin the cameras do not look at
        return np.linalg.inv(np.block([[pose[:3, :3], pose[:3, 3:] + 0.5], [np.zeros((1, 3)), 1]]))

    assert CHECKS["matches"](with_poses(WALL, shifted)).status is Status.FAILED


def test_images_without_texture_are_not_judged():
    finding = CHECKS["matches"](replace(WALL, pixels=torch.full_like(WALL.pixels, 90)))
    assert finding.status is Status.UNCHECKED and "few points in common (0 SIFT" in finding.reason


def test_views_far_apart_are_not_compared():
    apart = np.stack([camera_pose(azimuth, 0.2) for azimuth in (0, 2.1, 4.2)])
    scene = replace(WALL, pixels=WALL.pixels[:3], views=WALL.views[:3], cameras=WALL.cameras[:3])
    cameras = replace(scene.cameras, c2w=torch.from_numpy(apart).float())
    assert CHECKS["matches"](replace(scene, cameras=cameras)).status is Status.UNCHECKED


def test_reprojection_error_is_that_of_points_seen_and_moved():
    """A point between the cameras' rays: its own pixels have no error, pixels moved off the lines the right one."""
    a, b = WALL.cameras[0].to(torch.float64), WALL.cameras[3].to(torch.float64)
    world = np.random.default_rng(1).uniform(-0.3, 0.3, (20, 3))

    def seen(camera):
        local = (np.linalg.inv(camera.c2w.numpy()) @ np.c_[world, np.ones(20)].T)[:3]
        pixels = camera.K.numpy() @ local
        return (pixels[:2] / pixels[2]).T

    exact = reprojection_error(a, b, torch.from_numpy(seen(a)), torch.from_numpy(seen(b)))
    np.testing.assert_allclose(exact.numpy(), 0, atol=1e-4)  # poses are stored as fp32

    moved = seen(b) + [0.0, 4.0]  # the cameras differ in azimuth and height, so that lines are oblique
    for n, error in enumerate(reprojection_error(a, b, torch.from_numpy(seen(a)), torch.from_numpy(moved)).tolist()):
        rays = [
            c.c2w[:3, :3].numpy() @ np.linalg.solve(c.K.numpy(), [*p, 1]) for c, p in ((a, seen(a)[n]), (b, moved[n]))
        ]
        start = [c.c2w[:3, 3].numpy() for c in (a, b)]
        s, t = np.linalg.lstsq(np.stack([rays[0], -rays[1]], 1), start[1] - start[0], rcond=None)[0]
        middle = (start[0] + s * rays[0] + start[1] + t * rays[1]) / 2
        expected = []
        for camera, pixel in ((a, seen(a)[n]), (b, moved[n])):
            x = camera.K.numpy() @ (np.linalg.inv(camera.c2w.numpy()) @ [*middle, 1])[:3]
            expected.append(np.linalg.norm(x[:2] / x[2] - pixel))
        assert error == pytest.approx(max(expected), rel=1e-4)


def test_rays_that_meet_behind_the_cameras_do_not_meet():
    a, b = (WALL.cameras[view].to(torch.float64) for view in (0, 2))
    middle = torch.tensor([[SIZE / 2, SIZE / 2]], dtype=torch.float64)
    assert reprojection_error(a, b, middle, middle).item() < 1e-3  # both look at the origin
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    a, b = (replace(camera, c2w=camera.c2w @ turned) for camera in (a, b))
    assert reprojection_error(a, b, middle, middle).item() == float("inf")
