import numpy as np
import pytest

from nerfdiff.poses import look_at_origin, srn_spiral
from procedural.kinds.srn import intrinsics_text, pose_text
from procedural.poses import look_at, random_sphere

# Pose files 0, 1, 64, 100 and 250 of a test car rendered on the spiral of SRN-ShapeNet.
# fmt: off
CAR_POSES = {
    0: [-0.9129449725151062, -2.6523304086367716e-07, -0.40808194875717163, 0.5305066704750061,
        0.40808194875717163, -4.6272722897811036e-07, -0.9129451513290405, 1.186828851699829,
        1.2454208331291738e-07, -0.9999998807907104, 1.967826221971336e-07, 1.7763558229607138e-14, 0, 0, 0, 1],
    1: [-0.8774137496948242, 0.0030140201561152935, -0.4797249734401703, 0.6236426830291748,
        0.4797344505786896, 0.00551290949806571, -0.8773964643478394, 1.1406152248382568,
        1.955777406692505e-07, -0.9999802708625793, -0.006283054128289223, 0.008168087340891361, 0, 0, 0, 1],
    64: [-0.736555278301239, -0.2647160589694977, 0.6224238276481628, -0.809151291847229,
         -0.6763771176338196, 0.2882682979106903, -0.6778017282485962, 0.881142258644104,
         -1.7881384906104358e-07, -0.920231819152832, -0.39137378334999084, 0.5087859034538269, 0, 0, 0, 1],
    100: [0.5365725755691528, 0.49600473046302795, -0.6826924085617065, 0.8874998092651367,
          0.8438540101051331, -0.3153893053531647, 0.4340962767601013, -0.5643255114555359,
          1.7881384906104358e-07, -0.8090170621871948, -0.5877850651741028, 0.7641207575798035, 0, 0, 0, 1],
    250: [-1.0, -1.5099580252808664e-07, -1.1668784326648602e-14, 7.584709939376533e-15,
          -1.5099580252808664e-07, 1.0, -1.2518795949879914e-21, 5.048709793414476e-28,
          1.1668784326648602e-14, 5.100580237832016e-22, -1.0, 1.2999999523162842, 0, 0, 0, 1],
}
# fmt: on


@pytest.mark.parametrize("k", CAR_POSES)
def test_spiral_equals_real_pose_files(k):
    assert np.abs(srn_spiral(1.3)[k] - np.reshape(CAR_POSES[k], (4, 4))).max() < 1e-5


def test_spiral_scales_with_the_radius_and_shorter_ones_are_its_beginning():
    cars, chairs = srn_spiral(1.3), srn_spiral(2.0)
    assert cars.shape == (251, 4, 4)
    assert np.allclose(cars[:, :3, :3], chairs[:, :3, :3])
    assert np.allclose(cars[:, :3, 3] / 1.3, chairs[:, :3, 3] / 2.0)
    assert np.array_equal(srn_spiral(1.3, 10), cars[:10])


@pytest.mark.parametrize(
    "poses",
    [srn_spiral(2.0), random_sphere(2.0, 200, np.random.default_rng(0))],
    ids=["spiral", "sphere"],
)
def test_cameras_are_rigid_upright_and_look_at_the_origin_from_the_radius(poses):
    R, centre = poses[:, :3, :3], poses[:, :3, 3]
    assert np.allclose(R.transpose(0, 2, 1) @ R, np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(R), 1)
    assert np.allclose(np.linalg.norm(centre, axis=1), 2.0)
    # OpenCV: z goes forward, so the origin is on the optical axis at depth 2.
    assert np.allclose(R.transpose(0, 2, 1) @ -centre[..., None], np.array([[0], [0], [2.0]]), atol=1e-12)
    # x is level, and y points down in the image.
    assert np.allclose(R[:, 2, 0], 0) and (R[:, 2, 1] <= 1e-12).all()


def test_random_cameras_cover_the_whole_sphere_evenly():
    directions = random_sphere(1.0, 4000, np.random.default_rng(1))[:, :3, 3]
    # On a uniform sphere every coordinate is uniform on [−1, 1]: deviation 0.577 / √4000 = 0.009.
    assert np.abs(directions.mean(axis=0)).max() < 0.05
    assert np.abs((directions**2).mean(axis=0) - 1 / 3).max() < 0.03
    assert all(np.abs(np.quantile(d, [0.25, 0.75]) - [-0.5, 0.5]).max() < 0.06 for d in directions.T)


def test_straight_above_and_below_are_cameras_too():
    assert np.allclose(look_at_origin([0, 0, 2])[:3, :3], np.diag([-1, 1, -1]))
    below = look_at_origin([0, 0, -2])[:3, :3]
    assert np.allclose(below.T @ below, np.eye(3)) and np.linalg.det(below) == pytest.approx(1)


def test_intrinsics_at_128_are_those_of_srn_and_scale_with_the_resolution():
    assert intrinsics_text(128) == "131.250000 64.000000 64.000000 0.\n0. 0. 0.\n1.\n128 128\n"
    assert intrinsics_text(32).splitlines()[0] == "32.812500 16.000000 16.000000 0."


def test_pose_text_is_one_line_that_reads_back_exactly():
    pose = random_sphere(1.3, 1, np.random.default_rng(2))[0]
    text = pose_text(pose)
    assert "\n" not in text
    assert np.array_equal(np.array(text.split(), np.float64).reshape(4, 4), pose)


def test_elevations_bound_the_training_views_evenly():
    heights = random_sphere(2.0, 4000, np.random.default_rng(3), (0.0, 30.0))[:, 2, 3] / 2
    assert heights.min() >= 0 and heights.max() <= 0.5
    assert abs(heights.mean() - 0.25) < 0.01


def test_looking_at_another_point_is_looking_at_the_origin_moved_there():
    target, arm = np.array([0.3, -2.0, 0.7]), np.array([1.0, 2.0, -0.5])
    c2w = look_at(target + arm, target)
    assert np.array_equal(c2w[:3, :3], look_at_origin(arm)[:3, :3])
    assert np.allclose(c2w[:3, 3] + c2w[:3, 2] * np.linalg.norm(arm), target)
