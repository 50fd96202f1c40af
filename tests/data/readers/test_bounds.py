"""Near and far from cameras alone, against bounds that are known."""

import math

import numpy as np
import pytest

from nerfdiff.data.readers.bounds import MIN_NEAR, Gaze
from nerfdiff.utils.errors import DataError


def looking(centres: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Camera-to-world with OpenCV axes."""
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    for pose, centre in zip(poses, centres, strict=True):
        z = (at - centre) / np.linalg.norm(at - centre)
        x = np.cross(z, [0.1, 0.2, 1])
        x /= np.linalg.norm(x)
        pose[:3, :] = np.stack([x, np.cross(z, x), z, centre], 1)
    return poses


def sphere(views: int, distance: float, at, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(views, 3))
    return at + distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("at", [[0, 0, 0], [5.0, -3, 80]])
def test_axes_meet_where_cameras_look(at):
    at = np.array(at, dtype=float)
    gaze = Gaze.of(looking(sphere(12, 2.5, at), at))
    np.testing.assert_allclose(gaze.point, at, atol=1e-9)
    np.testing.assert_allclose(gaze.distances, 2.5, rtol=1e-9)
    assert gaze.ahead.all() and not gaze.parallel


@pytest.mark.parametrize(
    ("distance", "fov", "near", "far"),
    [
        (1.3, 2 * math.degrees(math.atan(64 / 131.25)), 0.8, 1.8),  # SRN cars, as published
        (4.0311, 39.6, 2.0, 6.0),  # Blender synthetic, as published; its objects are smaller than its bounds
        (4.9455, 40.0, 3.2, 6.7),  # ABO renders
    ],
)
def test_bounds_of_known_datasets_are_found_again(distance, fov, near, far):
    gaze = Gaze.of(looking(sphere(30, distance, np.zeros(3)), np.zeros(3)))
    found = gaze.bounds(math.radians(fov / 2), "scene")
    assert found == pytest.approx((near, far), rel=0.35 if near == 2.0 else 0.1)
    radius = distance * math.sin(math.radians(fov / 2))
    assert found == pytest.approx((distance - radius, distance + radius))


def test_bounds_enclose_the_ball_for_every_camera():
    centres = np.concatenate([sphere(20, 2.0, np.zeros(3)), sphere(21, 5.0, np.zeros(3), seed=1)])
    near, far = Gaze.of(looking(centres, np.zeros(3))).bounds(math.radians(15), "scene")
    radius = 5 * math.sin(math.radians(15))
    assert (near, far) == pytest.approx((2 - radius, 5 + radius))


def test_near_stays_before_cameras_inside_the_ball():
    """More than may be astray."""
    centres = np.concatenate([sphere(8, 4.0, np.zeros(3)), sphere(3, 0.1, np.zeros(3), seed=1)])
    near, far = Gaze.of(looking(centres, np.zeros(3))).bounds(math.radians(30), "scene")
    assert (near, far) == pytest.approx((MIN_NEAR * 0.1, 6.0))


STRAYS = {
    "20 times as far": lambda poses: scaled(poses, [7], 20),
    "5 times as far": lambda poses: scaled(poses, [0], 5),
    "a twentieth as far": lambda poses: scaled(poses, [7], 1 / 20),
    "two of them": lambda poses: scaled(scaled(poses, [3], 20), [9], 30),
    "far and turned away": lambda poses: moved(poses, 5, [40.0, -30, 20]),
}


def scaled(poses: np.ndarray, views: list[int], times: float) -> np.ndarray:
    poses = poses.copy()
    poses[views, :3, 3] = AT + times * (poses[views, :3, 3] - AT)
    return poses


def moved(poses: np.ndarray, view: int, centre: list[float]) -> np.ndarray:
    """Far off, and with an axis that misses by as much."""
    poses = poses.copy()
    poses[view, :3] = np.column_stack([np.eye(3), centre])
    return poses


AT = np.array([2.0, -1, 0.5])


@pytest.mark.parametrize("name", STRAYS)
def test_strays_do_not_set_the_bounds_of_all(name):
    """Case 05: one camera that was registered 20 times as far took far from 1.87 to 26.6."""
    right = looking(sphere(24, 1.3, AT), AT)
    poses = STRAYS[name](right)
    gaze, astray = Gaze.of(poses), np.flatnonzero((poses != right).any((1, 2)))
    assert np.flatnonzero(gaze.stray).tolist() == astray.tolist()
    np.testing.assert_allclose(gaze.point, AT, atol=1e-6)
    assert gaze.bounds(0.45, "scene") == pytest.approx(Gaze.of(right).bounds(0.45, "scene"), rel=1e-6)
    said = gaze.describe_strays([f"v{k}" for k in range(24)])
    assert all(f"view v{k} is" in said for k in astray) and said.count("view v") == len(astray)
    assert Gaze.of(right).describe_strays([f"v{k}" for k in range(24)]) is None


@pytest.mark.parametrize("views", [6, 24])
def test_a_stray_among_unsteady_hands_is_found(views):
    rng = np.random.default_rng(2)
    poses = np.concatenate([looking(c[None], rng.normal(0, 0.1, 3)) for c in sphere(views, 3.0, np.zeros(3))])
    poses = moved(poses, 2, [50.0, 10, -60])
    gaze = Gaze.of(poses)
    assert np.flatnonzero(gaze.stray).tolist() == [2] and np.linalg.norm(gaze.point) < 0.2


def test_a_second_ring_of_cameras_is_not_astray():
    """Close-ups and views of the whole; nor is one of four cameras, too few to say which is wrong."""
    centres = np.concatenate([sphere(12, 1.0, np.zeros(3)), sphere(8, 8.0, np.zeros(3), seed=1)])
    found = Gaze.of(looking(centres, np.zeros(3)))
    assert not found.stray.any() and found.bounds(0.3, "scene")[1] == pytest.approx(8 + math.sin(0.3))
    assert not Gaze.of(scaled(looking(sphere(4, 1.0, AT), AT), [1], 20)).stray.any()


def test_unsteady_hands_do_not_matter_much():
    rng = np.random.default_rng(3)
    poses = np.concatenate([looking(c[None], rng.normal(0, 0.1, 3)) for c in sphere(60, 3.0, np.zeros(3))])
    gaze = Gaze.of(poses)
    assert np.linalg.norm(gaze.point) < 0.1 and gaze.ahead.all()


@pytest.mark.parametrize("views", [1, 9])
def test_parallel_axes_say_nothing(views):
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :2, 3] = np.random.default_rng(0).normal(size=(views, 2))
    gaze = Gaze.of(poses)
    assert gaze.parallel
    gaze.refuse_outward("scene", "opengl")
    with pytest.raises(DataError, match=rf"scene: near and far .* {views} cameras.*data\.reader\.near"):
        gaze.bounds(0.4, "scene")


@pytest.mark.parametrize(("convention", "other"), [("opengl", "opencv"), ("opencv", "opengl")])
def test_cameras_turned_around_are_refused(convention, other):
    poses = looking(sphere(12, 2.5, np.zeros(3)), np.zeros(3))
    Gaze.of(poses).refuse_outward("scene", convention)
    with pytest.raises(DataError, match=rf"scene: 12 of 12 cameras look away.*convention={other}.*inward=false"):
        Gaze.of(poses * [1, -1, -1, 1]).refuse_outward("scene", convention)
    with pytest.raises(DataError, match="near and far cannot be estimated"):
        Gaze.of(poses * [1, -1, -1, 1]).bounds(0.4, "scene")


def test_a_few_strays_are_not_refused():
    poses = looking(sphere(12, 2.5, np.zeros(3)), np.zeros(3))
    poses[:3] *= [1, -1, -1, 1]
    gaze = Gaze.of(poses)
    gaze.refuse_outward("scene", "opengl")
    assert gaze.ahead.sum() == 9 and gaze.bounds(0.3, "scene") == pytest.approx(
        (2.5 * (1 - math.sin(0.3)), 2.5 * (1 + math.sin(0.3)))
    )
