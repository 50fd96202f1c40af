"""Search for a misreading of the cameras that would explain why they do not fit their images."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Check, Status, check_scene


def _turned(x: int, y: int, z: int) -> Callable[[Cameras], Cameras]:
    """The camera's own axes reversed where -1."""

    def mend(cameras: Cameras) -> Cameras:
        return replace(cameras, c2w=cameras.c2w * cameras.c2w.new_tensor([x, y, z, 1]))

    return mend


def _inverted(cameras: Cameras) -> Cameras:
    R, t = cameras.c2w[:, :3, :3].mT, cameras.c2w[:, :3, 3:]
    return _posed(cameras, R, -R @ t)


def _transposed(cameras: Cameras) -> Cameras:
    return _posed(cameras, cameras.c2w[:, :3, :3].mT, cameras.c2w[:, :3, 3:])


def _posed(cameras: Cameras, R: Float[Tensor, "views 3 3"], t: Float[Tensor, "views 3 1"]) -> Cameras:
    return replace(cameras, c2w=torch.cat([torch.cat([R, t], 2), cameras.c2w[:, 3:]], 1))


def _rescaled(cameras: Cameras) -> Cameras:
    """K at the resolution at which its principal point is the image's middle."""
    scale = cameras.width / (2 * cameras.K[:, 0, 2]), cameras.height / (2 * cameras.K[:, 1, 2])
    K = cameras.K.clone()
    K[:, 0] *= scale[0][:, None]
    K[:, 1] *= scale[1][:, None]
    return replace(cameras, K=K)


MENDS: dict[str, Callable[[Cameras], Cameras]] = {
    "the camera axes are OpenGL's (y up, z backward), not OpenCV's": _turned(1, -1, -1),
    "the poses are world-to-camera": _inverted,
    "the poses are world-to-camera, with OpenGL axes": lambda cameras: _turned(1, -1, -1)(_inverted(cameras)),
    "the intrinsics are those of another resolution": _rescaled,
    "the rotations are transposed": _transposed,
    "the images are upside down (x and y reversed)": _turned(-1, -1, 1),
    "the y axis alone is reversed": _turned(1, -1, 1),
    "the x axis alone is reversed, or the images are mirrored": _turned(-1, 1, 1),
    "the z axis alone is reversed": _turned(1, 1, -1),
}


def explanations(scene: Scene, checks: Mapping[str, Check]) -> list[str]:
    """Misreadings without which no check of the scene's cameras would fail, and its images agree with its cameras."""
    checks = {name: check for name, check in checks.items() if check.judges_cameras}
    return [name for name, mend in MENDS.items() if _passes(replace(scene, cameras=mend(scene.cameras)), checks)]


def _passes(scene: Scene, checks: Mapping[str, Check]) -> bool:
    findings = check_scene(scene, checks)
    if any(finding.status is Status.FAILED for finding in findings.values()):
        return False
    return any(check.matches_images and findings[name].status is Status.OK for name, check in checks.items())
