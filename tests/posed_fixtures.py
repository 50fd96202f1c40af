"""Small scenes with a transforms.json whose every pixel is known, by a projection that shares no code with nerfdiff.

A camera is built as Blender builds it: right, up and backward vectors and a position.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

HEIGHT, WIDTH = 40, 56
FX, FY, CX, CY = 60.0, 55.0, 26.0, 21.5  # all different, so that what is swapped shows
CENTRE = np.array([3.0, -1.0, 2.0])  # what the cameras look at is not the origin

# no symmetry maps this set onto itself: a flipped or swapped axis puts a colour elsewhere
POINTS = CENTRE + np.array(
    [[0.0, 0.0, 0.0], [0.6, 0.05, 0.1], [-0.1, 0.5, -0.2], [0.2, -0.3, 0.5], [-0.5, -0.35, -0.1]]
)
COLOURS = np.array([[0, 0, 0], [230, 20, 40], [20, 200, 30], [10, 40, 220], [240, 180, 10]], dtype=np.uint8)
SETTINGS = {
    "near": None,
    "far": None,
    "convention": "opengl",
    "inward": True,
    "white_background": True,
    "split_sizes": {"train": 80, "val": 10, "test": 10},
    "split_seed": 0,
}


def camera(azimuth: float, elevation: float, distance: float = 3.0) -> np.ndarray:
    """Camera-to-world as nerfstudio and Blender write it: columns right, up, backward, position."""
    flat = np.cos(elevation)
    backward = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(backward, right)
    assert up[2] > 0
    return np.vstack([np.stack([right, up, backward, CENTRE + distance * backward], 1), [0, 0, 0, 1]])


def cameras(views: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([camera(rng.uniform(0, 6.28), rng.uniform(-0.5, 1.2), rng.uniform(2.8, 3.2)) for _ in range(views)])


def project(
    pose: np.ndarray, points: np.ndarray = POINTS, intrinsics: Sequence[float] = (FX, FY, CX, CY)
) -> np.ndarray:
    """(u, v, depth) of each point: u to the right, v downward from the upper left corner."""
    fx, fy, cx, cy = intrinsics
    rows = []
    for point in points:
        right, up, backward = (float((point - pose[:3, 3]) @ pose[:3, axis]) for axis in range(3))
        rows.append([cx + fx * right / -backward, cy - fy * up / -backward, -backward])
    return np.array(rows)


def draw(pose: np.ndarray, height: int, width: int, intrinsics: Sequence[float], background: int = 90) -> np.ndarray:
    """RGBA: a transparent grey, with an opaque coloured square around the pixel that holds each point."""
    image = np.full((height, width, 4), background, np.uint8)
    image[..., 3] = 0
    projected = project(pose, intrinsics=intrinsics)
    for k in np.argsort(-projected[:, 2]):
        u, v = np.floor(projected[k, :2]).astype(int)
        image[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2] = [*COLOURS[k], 255]
    return image


def write_nerfstudio(
    folder: Path,
    views: int = 6,
    seed: int = 0,
    per_frame: bool = False,
    scales: Sequence[int] = (1,),
    masks: bool = True,
    suffix: str = ".png",
    **top,
) -> np.ndarray:
    """One scene; returns its OpenGL poses.

    View k is stored at `scales[k % n]` times the size of the others; then, and with `per_frame`, intrinsics stand in
    its frame. Images have no alpha, masks stand beside them.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    poses, frames = cameras(views, seed), []
    for k, pose in enumerate(poses):
        scale = scales[k % len(scales)]
        height, width, intrinsics = HEIGHT * scale, WIDTH * scale, [x * scale for x in (FX, FY, CX, CY)]
        rgba = draw(pose, height, width, intrinsics)
        frame = {"file_path": f"images/frame_{k + 1:05d}{suffix}", "transform_matrix": pose.tolist()}
        Image.fromarray(rgba[..., :3]).save(folder / frame["file_path"])
        if masks:
            frame["mask_path"] = f"masks/frame_{k + 1:05d}.png"
            Image.fromarray(rgba[..., 3]).save(folder / frame["mask_path"])
        if per_frame or len(scales) > 1:
            frame |= dict(zip(("fl_x", "fl_y", "cx", "cy"), intrinsics, strict=True)) | {"w": width, "h": height}
        frames.append(frame)
    shared = (
        {} if per_frame or len(scales) > 1 else {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    )
    lens = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    content = {**lens, **shared, **top, "frames": frames, "applied_transform": np.eye(4)[:3].tolist()}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1))
    return poses


def write_blender(folder: Path, views: tuple[int, int, int] = (4, 2, 3), seed: int = 0) -> dict[str, np.ndarray]:
    """One scene as Blender-synthetic; returns its OpenGL poses by view name. The lens is FX wide, pixels are square."""
    poses = {}
    for name, count in zip(("train", "val", "test"), views, strict=True):
        (folder / name).mkdir(parents=True)
        frames = []
        for k, pose in enumerate(cameras(count, seed * 1000 + 10 * len(poses))):
            rgba = draw(pose, HEIGHT, WIDTH, (FX, FX, WIDTH / 2, HEIGHT / 2))
            Image.fromarray(rgba).save(folder / name / f"r_{k}.png")
            frames.append({"file_path": f"./{name}/r_{k}", "rotation": 0.01, "transform_matrix": pose.tolist()})
            poses[f"{name}_r_{k}"] = pose
        content = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FX), "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(content))
    return poses
