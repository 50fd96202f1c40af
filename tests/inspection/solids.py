"""Coloured balls on white, cast in float64 without nerfdiff: images, masks and depths that belong together exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from data_fixtures import camera_pose
from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene

HEIGHT, WIDTH = 48, 64
F, CX, CY = 62.0, 33.0, 23.0
NEAR, FAR = 0.8, 1.8
# no rotation or reflection maps the set onto itself
CENTRES = np.array([[0.12, 0.05, -0.05], [-0.2, 0.1, 0.02], [-0.05, -0.2, 0.1], [0.1, -0.02, 0.27], [0.3, -0.05, -0.1]])
RADII = np.array([0.16, 0.11, 0.08, 0.07, 0.06])


def orbit_poses(views: int, seed: int = 0) -> np.ndarray:
    """All around, above and below."""
    rng = np.random.default_rng(seed)
    azimuths = np.arange(views) * 2.4 + rng.uniform(0, 6)
    return np.stack([camera_pose(a, e) for a, e in zip(azimuths, rng.uniform(-0.9, 1.2, views), strict=True)])


def cast(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(8-bit image, z-depth with 0 where nothing is)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack([(u - CX) / F, (v - CY) / F, np.ones_like(u)], -1)  # z = 1: ray parameters are z-depths
    directions, origin = local @ pose[:3, :3].T, pose[:3, 3]
    depth = np.full(u.shape, np.inf)
    for centre, radius in zip(CENTRES, RADII, strict=True):
        a = (directions**2).sum(-1)
        b = directions @ (origin - centre)
        root = b**2 - a * (((origin - centre) ** 2).sum() - radius**2)
        hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        depth = np.minimum(depth, hit)
    seen = np.isfinite(depth)
    points = origin + directions * np.where(seen, depth, 0)[..., None]
    colours = 110 + 90 * np.sin(9 * points + [0, 1, 2])
    image = np.where(seen[..., None], colours, 255).astype(np.uint8)
    return image, np.where(seen, depth, 0)


def solid_scene(views: int = 12, seed: int = 0, mask: bool = False, depth: bool = False, poses=None) -> Scene:
    poses = orbit_poses(views, seed) if poses is None else poses
    images, depths = (np.stack(each) for each in zip(*map(cast, poses), strict=True))
    K = torch.tensor([[F, 0, CX], [0, F, CY], [0, 0, 1]]).expand(len(poses), 3, 3)
    return Scene(
        id=f"solid{seed}",
        views=tuple(f"{view:06d}" for view in range(len(poses))),
        pixels=torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(),
        cameras=Cameras(torch.from_numpy(poses).float(), K, HEIGHT, WIDTH),
        near=NEAR,
        far=FAR,
        mask=torch.from_numpy(depths > 0) if mask else None,
        depth=torch.from_numpy(depths).float() if depth else None,
    )


def with_poses(scene: Scene, change) -> Scene:
    """The scene with `change` (of one 4×4 numpy matrix) applied to each pose."""
    poses = np.stack([change(pose) for pose in scene.cameras.c2w.double().numpy()])
    return replace(scene, cameras=replace(scene.cameras, c2w=torch.from_numpy(poses).float()))


def with_K(scene: Scene, change) -> Scene:
    K = np.stack([change(K.copy()) for K in scene.cameras.K.numpy()])
    return replace(scene, cameras=replace(scene.cameras, K=torch.from_numpy(K).float()))


def write_solids(root: Path, splits: dict[str, int], views: int = 10, truth: bool = False, change=lambda pose: pose):
    """An SRN-layout dataset of them; `change` is applied to each pose that is written."""
    for split, scenes in splits.items():
        for number in range(scenes):
            folder = root / f"cars_{split}" / f"scene{number}"
            for kind in ("rgb", "pose", *(("depth", "mask") if truth else ())):
                (folder / kind).mkdir(parents=True)
            (folder / "intrinsics.txt").write_text(f"{F} {CX} {CY} 0.\n0. 0. 0.\n1.\n{HEIGHT} {WIDTH}\n")
            for view, pose in enumerate(orbit_poses(views, number)):
                image, depth = cast(pose)
                Image.fromarray(image).save(folder / "rgb" / f"{view:06d}.png")
                (folder / "pose" / f"{view:06d}.txt").write_text(" ".join(map(repr, change(pose).ravel().tolist())))
                if truth:
                    Image.fromarray((depth > 0).astype(np.uint8) * 255).save(folder / "mask" / f"{view:06d}.png")
                    np.savez_compressed(folder / "depth" / f"{view:06d}.npz", depth=depth.astype("f4"))
