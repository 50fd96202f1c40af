"""The convention of poses is told from where cameras look, and objects come to the origin at one distance."""

import logging

import numpy as np
import pytest

from abo_fixtures import blender_poses
from nerfdiff.data.readers.optical_axes import check_settings, object_cameras, report
from nerfdiff.utils.errors import ConfigError, DataError

FLIP = np.diag([1.0, -1, -1, 1])
CENTRE = np.array([0.4, -0.2, 1.3])
FORMS = {
    ("opengl", False): lambda pose: pose,
    ("opencv", False): lambda pose: pose @ FLIP,
    ("opengl", True): np.linalg.inv,
    ("opencv", True): lambda pose: np.linalg.inv(pose @ FLIP),
}


def names(poses) -> tuple[str, ...]:
    return tuple(f"v{k}" for k in range(len(poses)))


def interpret(poses, convention="auto"):
    return object_cameras(np.asarray(poses), convention, "file.json", names(poses))


@pytest.mark.parametrize("views", [2, 3, 30])
@pytest.mark.parametrize("centre", [CENTRE, np.zeros(3), CENTRE * 1e-5, CENTRE * 1e3])
@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_cameras(form, centre, views):
    blender = blender_poses(views, seed=views, centre=centre, scale=0.7)
    # as files have them: rounded to single precision
    written = np.stack([FORMS[form](pose) for pose in blender]).astype(np.float32).astype(np.float64)
    found = interpret(written)
    size = np.abs(centre).max() + 3.5
    assert (found.convention, found.inverted) == form
    np.testing.assert_allclose(found.c2w, blender @ FLIP, atol=1e-6 * size)
    np.testing.assert_allclose(found.centre, centre, atol=1e-5 * size)
    assert found.distance == pytest.approx(4.9455 * 0.7, rel=1e-4) and found.residual < 1e-3


def test_the_convention_may_be_given():
    blender = blender_poses(5, seed=1, centre=CENTRE, scale=2.0)
    assert interpret(blender, "opengl").convention == "opengl"
    assert interpret(blender @ FLIP, "opencv").convention == "opencv"
    for poses, wrong, right in ((blender, "opencv", "opengl"), (blender @ FLIP, "opengl", "opencv")):
        with pytest.raises(DataError, match=rf"file\.json: convention={wrong}.*look away.*auto or {right}"):
            interpret(poses, wrong)
    with pytest.raises(DataError, match=r"optical axes of the 5 views do not meet"):
        interpret([np.linalg.inv(pose) for pose in blender], "opengl")


def test_normalising_moves_the_intersection_to_the_origin_and_scales_the_distance():
    blender = blender_poses(6, seed=2, centre=CENTRE, scale=0.05)
    found = interpret(blender)
    moved = found.normalised(4.9455)
    np.testing.assert_allclose(np.linalg.norm(moved.c2w[:, :3, 3], axis=1), 4.9455, rtol=1e-9)
    np.testing.assert_allclose(moved.c2w[:, :3, 3], (blender[:, :3, 3] - CENTRE) / 0.05, atol=1e-8)
    assert np.array_equal(moved.c2w[:, :3, :3], found.c2w[:, :3, :3])
    np.testing.assert_allclose(found.c2w[:, :3, 3], blender[:, :3, 3])  # left as they were


def test_cameras_need_not_look_exactly_at_one_point():
    blender = blender_poses(30, seed=3, centre=CENTRE, scale=1.0)
    blender[:, :3, 3] += np.random.default_rng(0).normal(0, 0.03, (30, 3))
    found = interpret(blender)
    assert found.convention == "opengl" and 1e-3 < found.residual < 0.02
    np.testing.assert_allclose(found.centre, CENTRE, atol=0.03)


def test_cameras_that_look_at_nothing_in_common_are_refused():
    rng = np.random.default_rng(1)
    poses = np.stack([np.eye(4)] * 12)
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(12, 3, 3)))[0]
    poses[:, :3, :3] *= np.linalg.det(poses[:, :3, :3])[:, None, None]
    poses[:, :3, 3] = rng.normal(size=(12, 3))
    with pytest.raises(DataError, match=r"file\.json: the optical axes of the 12 views neither as camera-to-world"):
        interpret(poses)


def test_parallel_axes_are_refused():
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = [0, 1, 2]
    for some in (poses, poses[:1]):
        with pytest.raises(DataError, match=r"at least two views that look at one object from different directions"):
            interpret(some)


def test_views_of_two_conventions_are_named():
    poses = blender_poses(6, seed=4, centre=CENTRE, scale=1.0)
    poses[4] = poses[4] @ FLIP
    with pytest.raises(DataError, match=r"file\.json: the views do not share one convention: v4 look the other way"):
        interpret(poses)


def test_poses_that_are_not_rigid_are_named():
    for change in (lambda p: p * [2, 2, 2, 1], lambda p: p * [-1, 1, 1, 1], lambda p: p + [[0, 0, 0, np.nan]]):
        poses = blender_poses(4, seed=5, centre=CENTRE, scale=1.0)
        poses[2] = change(poses[2])
        with pytest.raises(DataError, match=r"file\.json: view v2"):
            interpret(poses)


def test_settings():
    check_settings(3.2, 6.7, 4.9455, "auto")
    with pytest.raises(ConfigError, match="'blender' is unknown; choose one of auto, opengl, opencv"):
        check_settings(3.2, 6.7, 4.9455, "blender")
    for near, far, distance in ((0, 6.7, 5), (5, 6.7, 4), (3, 4, 5), (3, np.nan, 5)):
        with pytest.raises(ConfigError, match="0 < near < distance < far"):
            check_settings(near, far, distance, "auto")


def test_what_was_found_is_logged_once_and_a_change_of_convention_again(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    blender = blender_poses(4, seed=6, centre=CENTRE, scale=1.0)
    for _ in range(3):
        report(tmp_path, interpret(blender))
    (record,) = caplog.records
    assert record.levelname == "INFO" and "camera-to-world matrices with OpenGL/Blender axes" in record.message
    assert "(0.4, -0.2, 1.3)" in record.message
    for _ in range(2):
        report(tmp_path, interpret(blender @ FLIP))
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING"]
    assert "OpenCV axes" in caplog.records[1].message
