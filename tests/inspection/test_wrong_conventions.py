"""Every common misreading of cameras must fail a check, with and without depth; right cameras must pass all."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from solids import solid_scene, with_K, with_poses

from nerfdiff.cli import load_config
from nerfdiff.inspection.check import Status, check_scene
from nerfdiff.inspection.conventions import explanations

CHECKS = {name: instantiate(check) for name, check in load_config("inspect_data", []).checks.items()}


def flipped(*signs):
    return lambda pose: pose @ np.diag([*signs, 1.0])


def transposed(pose):
    return np.block([[pose[:3, :3].T, pose[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def off_centre(K):
    K[0, 2] += 12  # of 64 pixels
    return K


def scaled(factor, rows=(0, 1)):
    def change(K):
        K[list(rows)] *= factor
        return K

    return change


def longer(K):
    K[0, 0] *= 1.3
    K[1, 1] *= 1.3
    return K


WRONG = {
    "opengl": (with_poses, flipped(1, -1, -1), {"optical_axes", "depth", "silhouettes"}),
    "y flipped": (with_poses, flipped(1, -1, 1), {"poses", "depth", "silhouettes"}),
    "x mirrored": (with_poses, flipped(-1, 1, 1), {"poses", "depth", "silhouettes"}),
    "upside down": (with_poses, flipped(-1, -1, 1), {"depth", "silhouettes"}),
    "world-to-camera": (with_poses, np.linalg.inv, {"optical_axes", "depth", "silhouettes"}),
    "OpenGL's world-to-camera": (
        with_poses,
        lambda pose: np.linalg.inv(flipped(1, -1, -1)(pose)),
        {"optical_axes", "depth", "silhouettes"},
    ),
    "transposed": (with_poses, transposed, {"optical_axes", "depth", "silhouettes"}),
    "K of twice the resolution": (with_K, scaled(2), {"intrinsics", "depth", "silhouettes"}),
    "K of half the resolution": (with_K, scaled(0.5), {"intrinsics", "depth", "silhouettes"}),
    "principal point off": (with_K, off_centre, {"depth", "silhouettes"}),
}
TRUTH = {"white": {}, "mask": {"mask": True}, "depth": {"depth": True}}


def failed(scene):
    return {name for name, finding in check_scene(scene, CHECKS).items() if finding.status is Status.FAILED}


@pytest.mark.parametrize("truth", TRUTH)
@pytest.mark.parametrize("seed", range(3))
def test_right_cameras_pass_every_check(truth, seed):
    findings = check_scene(solid_scene(seed=seed, **TRUTH[truth]), CHECKS)
    assert {name for name, f in findings.items() if f.status is Status.FAILED} == set()
    assert findings["silhouettes"].status is Status.OK
    assert findings["depth"].status is (Status.OK if truth == "depth" else Status.UNCHECKED)
    assert findings["matches"].reason == "not needed: cameras and images are compared otherwise"


@pytest.mark.parametrize("truth", TRUTH)
@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_cameras_fail(wrong, truth):
    apply, change, expected = WRONG[wrong]
    found = failed(apply(solid_scene(**TRUTH[truth]), change))
    assert found >= expected - (set() if truth == "depth" else {"depth"})


def test_a_wrong_focal_length_shows_in_depth():
    assert "depth" in failed(with_K(solid_scene(depth=True), longer))


def test_a_world_that_is_mirrored_as_a_whole_fits_its_images_but_has_no_right_handed_poses():
    mirrored = with_poses(solid_scene(depth=True), lambda pose: np.diag([1.0, -1.0, 1.0, 1.0]) @ pose)
    assert failed(mirrored) == {"poses"}


def test_images_that_do_not_belong_to_their_depths_show_in_the_colours():
    scene = solid_scene(depth=True, mask=True)
    finding = CHECKS["depth"](replace(scene, pixels=scene.pixels.flip(-1)))
    assert finding.status is Status.FAILED and "colours do not belong" in finding.reason


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("opengl", "OpenGL's"),
        ("world-to-camera", "are world-to-camera"),
        ("OpenGL's world-to-camera", "world-to-camera, with OpenGL axes"),
        ("transposed", "transposed"),
        ("upside down", "upside down"),
        ("y flipped", "y axis alone"),
        ("x mirrored", "x axis alone"),
    ],
)
def test_the_misreading_is_named(wrong, words):
    apply, change, _ = WRONG[wrong]
    (name,) = explanations(apply(solid_scene(), change), CHECKS)
    assert words in name


@pytest.mark.parametrize("factor", [0.5, 2])
def test_intrinsics_of_another_resolution_are_named(factor):
    scene = solid_scene(depth=True)
    centred = with_K(scene, lambda K: np.diag([factor, factor, 1]).astype("f4") @ K)
    found = explanations(centred, {**CHECKS, "depth": replace(CHECKS["depth"], min_agreement=0.8)})
    assert found == ["the intrinsics are those of another resolution"]


def test_masks_and_colours_complete_each_other():
    """A mask that misses a thin part and a part as white as the background: each alone looks like wrong cameras."""
    scene = solid_scene(mask=True, seed=1)
    thin, white = scene.mask.clone(), scene.pixels.clone()
    for view in range(0, len(scene.views), 3):
        thin[view, :, : int(scene.mask[view].any(0).nonzero().float().mean())] = False
        white[view, :, :, int(scene.mask[view].any(0).nonzero().float().mean()) :] = 255
    silhouettes = CHECKS["silhouettes"]
    assert replace(silhouettes, background=None)(replace(scene, mask=thin)).status is Status.FAILED
    assert silhouettes(replace(scene, mask=None, pixels=white)).status is Status.FAILED
    assert silhouettes(replace(scene, mask=thin)).status is Status.OK
    assert silhouettes(replace(scene, pixels=white)).status is Status.OK


def test_photographs_have_no_silhouettes_but_masks_are_enough():
    scene = solid_scene(mask=True)
    photographs = replace(scene, pixels=(scene.pixels // 2))  # grey all around
    assert CHECKS["silhouettes"](photographs).status is Status.OK
    assert "runs out of the images" in CHECKS["silhouettes"](replace(photographs, mask=None)).reason
    assert "anything in them" in CHECKS["silhouettes"](replace(scene, pixels=scene.pixels * 0 + 255, mask=None)).reason


def test_shuffled_poses_have_no_explanation():
    scene = solid_scene()
    order = torch.roll(torch.arange(len(scene.views)), 1)
    assert explanations(replace(scene, cameras=scene.cameras[order]), CHECKS) == []
