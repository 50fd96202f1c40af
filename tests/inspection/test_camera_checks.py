"""Each number against a closed form, each limit from both sides."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from solids import CX, CY, HEIGHT, WIDTH, F, orbit_poses, solid_scene, with_K, with_poses

from data_fixtures import camera_pose
from nerfdiff.inspection.bounds import Bounds, ray_distance, scene_distances
from nerfdiff.inspection.camera_checks import Intrinsics, OpticalAxes, Poses, field_of_view, turn
from nerfdiff.inspection.check import Finding, Status, verdict

INTRINSICS = Intrinsics(max_offset=0.2, min_fov=5, max_fov=150, tolerated=0)
POSES = Poses(max_deviation=1e-3, tolerated=0)
AXES = OpticalAxes(max_residual=0.25, min_in_front=0.9, min_turn=5, min_spread=1e-3, tolerated=0)
BOUNDS = Bounds(background=1.0, max_outside=0.01, tolerance=1e-3, min_turn=5, tolerated=0)
SCENE = solid_scene(depth=True)


def test_intrinsics_measure_the_principal_point():
    finding = INTRINSICS(SCENE)
    assert finding.status is Status.OK
    assert finding.value == pytest.approx(max(abs(CX / WIDTH - 0.5), abs(CY / HEIGHT - 0.5)))
    assert field_of_view(SCENE.cameras)[0].item() == pytest.approx(math.degrees(2 * math.atan(WIDTH / 2 / F)))


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        ((0, 2), WIDTH * 0.71, "another resolution"),
        ((1, 2), HEIGHT * 0.29, "another resolution"),
        ((0, 0), -F, "positive"),
        ((1, 1), math.nan, "finite"),
        ((0, 0), 1e4, "field of view"),
        ((0, 0), 1.0, "field of view"),
        ((0, 1), 0.5, "K is not"),
        ((2, 2), 2.0, "K is not"),
    ],
)
def test_intrinsics_fail(entry, value, words):
    def change(K):
        K[entry] = value
        return K

    finding = INTRINSICS(with_K(SCENE, change))
    assert finding.status is Status.FAILED and words in finding.reason


def test_intrinsics_name_the_view():
    K = SCENE.cameras.K.clone()
    K[7, 0, 2] = 0
    finding = INTRINSICS(replace(SCENE, cameras=replace(SCENE.cameras, K=K)))
    assert f"view {SCENE.views[7]} " in finding.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda pose: pose @ np.diag([1.01, 1.01, 1.01, 1]), "not a rotation"),
        (lambda pose: pose + np.eye(4)[3][:, None] * [0.1, 0, 0, 0], "not a rotation"),
        (lambda pose: pose * np.nan, "NaN"),
        (lambda pose: pose @ np.diag([-1, 1, 1, 1]), "12 of 12 poses mirror space"),
    ],
)
def test_poses_fail(change, words):
    finding = POSES(with_poses(SCENE, change))
    assert finding.status is Status.FAILED and words in finding.reason


def test_axes_that_miss_by_a_known_angle():
    """Cameras on a circle, all turned by the same angle about the vertical: axes are tangent to a circle of
    radius r·sin, whose centre lies r·cos ahead, and r from the camera."""
    for degrees, status in ((10, Status.OK), (20, Status.FAILED)):
        a = math.radians(degrees)
        turned = np.array(
            [[math.cos(a), 0, math.sin(a), 0], [0, 1, 0, 0], [-math.sin(a), 0, math.cos(a), 0], [0, 0, 0, 1]]
        )
        ring = np.stack([camera_pose(angle, 0.0) @ turned for angle in np.arange(8) * math.pi / 4])
        finding = AXES(solid_scene(poses=ring))
        assert finding.value == pytest.approx(math.sin(a), abs=1e-4)
        assert finding.status is status


def test_axes_tolerate_one_camera_that_looks_away():
    def look_away(poses, count):
        poses = poses.copy()
        poses[:count] = poses[:count] @ np.diag([-1.0, 1, -1, 1])
        return solid_scene(poses=poses)

    poses = orbit_poses(12)
    assert AXES(look_away(poses, 1)).status is Status.OK
    finding = AXES(look_away(poses, 2))
    assert finding.status is Status.FAILED and "behind 17% of them" in finding.reason


def test_near_parallel_axes_are_not_judged():
    track = np.stack([np.block([[np.eye(3), np.array([[x], [0], [0]])], [np.zeros((1, 3)), 1]]) for x in (0, 1, 2.0)])
    scene = replace(solid_scene(poses=track), depth=None)
    assert turn(scene.cameras) == 0
    assert AXES(scene).status is Status.UNCHECKED
    assert BOUNDS(scene).status is Status.UNCHECKED
    assert AXES(solid_scene(views=1)).status is Status.UNCHECKED


def test_cameras_in_one_place_are_named():
    turning = orbit_poses(6)
    turning[:, :3, 3] = [0, 0, 1.3]
    assert "one place" in AXES(solid_scene(poses=turning)).reason


def test_ray_distances_are_those_to_the_points():
    """Against the pixel's point, unprojected one by one."""
    distances = ray_distance(SCENE.depth[:1], SCENE.cameras[:1])[0]
    for y, x in SCENE.depth[0].nonzero().tolist()[::37]:
        z = SCENE.depth[0, y, x].item()
        expected = np.linalg.norm([(x + 0.5 - CX) / F * z, (y + 0.5 - CY) / F * z, z])
        assert distances[y, x].item() == pytest.approx(expected, rel=1e-5)


def test_bounds_count_surfaces_outside():
    distances, evidence = scene_distances(SCENE)
    assert evidence == "surfaces" and len(distances) == int((SCENE.depth > 0).sum())
    near = np.quantile(distances.numpy(), 0.2)
    finding = BOUNDS(replace(SCENE, near=float(near)))
    assert finding.status is Status.FAILED and finding.value == pytest.approx(0.2, abs=0.01)
    assert "surfaces at distances of" in finding.reason
    assert BOUNDS(SCENE) == Finding(Status.OK, 0.0)


def test_a_real_background_may_lie_beyond_far():
    """Half of what has depth lies beyond far: fine for a backdrop, not for what masks hold."""
    far = float(scene_distances(SCENE)[0].median())
    beyond = replace(SCENE, far=far)
    backdrop = replace(BOUNDS, background=None)
    assert BOUNDS(beyond).status is Status.FAILED
    assert backdrop(beyond).status is Status.OK
    assert backdrop(replace(beyond, near=far * 0.99)).status is Status.FAILED
    inside = (SCENE.depth > 0) & (ray_distance(SCENE.depth, SCENE.cameras) < far)
    assert backdrop(replace(beyond, mask=inside)).status is Status.OK
    assert backdrop(replace(beyond, mask=SCENE.depth > 0)).value == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("near", "far", "status"), [(1.2, 1.4, "ok"), (1.31, 1.8, "failed"), (0.8, 1.29, "failed")])
def test_bounds_without_depth_hold_what_the_cameras_look_at(near, far, status):
    scene = replace(solid_scene(), near=near, far=far)  # the cameras are 1.3 from the origin
    assert BOUNDS(scene).status == status


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 1.0), (1.0, math.inf), (math.nan, 2.0)])
def test_bounds_must_be_ordered(near, far):
    assert "must satisfy" in BOUNDS(replace(SCENE, near=near, far=far)).reason


def test_bounds_without_a_hit_are_not_judged():
    assert BOUNDS(replace(SCENE, depth=torch.zeros_like(SCENE.depth))).status is Status.UNCHECKED


def test_a_verdict_tolerates_a_share_of_the_scenes():
    findings = {f"s{n}": Finding.judged(float(n), "too large" if n > 7 else None) for n in range(10)}
    for tolerated, status in ((0.2, Status.OK), (0.1, Status.FAILED)):
        found = verdict("axes", replace(AXES, tolerated=tolerated), findings)
        assert found.status is status
        assert (found.median, found.worst, found.scenes) == (4.5, 9.0, 10)
        assert found.suspects == {"s8": "too large", "s9": "too large"}
        assert ("2 of 10 scenes suspect" if status is Status.OK else "2 of 10 scenes: too large") in found.text


def test_a_verdict_of_nothing_is_not_checked():
    findings = {"a": Finding.unchecked("no depth"), "b": Finding.unchecked("no depth")}
    assert verdict("axes", AXES, findings).text == "no depth"
    assert verdict("axes", AXES, {}).status is Status.UNCHECKED
