"""Small SRN-layout datasets whose every pixel is known, drawn by a projection that shares no code with nerfdiff."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

HEIGHT, WIDTH = 40, 56
F, CX, CY = 50.0, 27.0, 21.5  # not the centre, so that swapped axes show
NEAR, FAR = 0.8, 1.8

# no symmetry maps this set onto itself: a flipped or swapped axis puts a colour elsewhere
POINTS = np.array([[0.0, 0.0, 0.0], [0.25, 0.02, 0.05], [-0.05, 0.2, -0.1], [0.08, -0.12, 0.22], [-0.2, -0.15, -0.03]])
COLOURS = np.array([[0, 0, 0], [230, 20, 40], [20, 200, 30], [10, 40, 220], [240, 180, 10]], dtype=np.uint8)


def camera_pose(azimuth: float, elevation: float, radius: float = 1.3) -> np.ndarray:
    """cam2world looking at the origin, z-up world, x right, y down, z forward."""
    centre = radius * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    z = -centre / radius
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    return np.vstack([np.stack([x, np.cross(z, x), z, centre], axis=1), [0, 0, 0, 1]])


def poses(views: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([camera_pose(rng.uniform(0, 6.28), rng.uniform(-1.2, 1.2)) for _ in range(views)])


def project(pose: np.ndarray, points: np.ndarray = POINTS) -> np.ndarray:
    """(u, v, depth) of each point, one at a time and by inverting the matrix."""
    rows = []
    for point in points:
        x, y, z, _ = np.linalg.inv(pose) @ [*point, 1.0]
        rows.append([F * x / z + CX, F * y / z + CY, z])
    return np.array(rows)


def draw(pose: np.ndarray, radius: int = 1) -> np.ndarray:
    """White, with a coloured square around the pixel that holds each point; nearer ones cover farther ones."""
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    projected = project(pose)
    for k in np.argsort(-projected[:, 2]):
        u, v = int(np.floor(projected[k, 0])), int(np.floor(projected[k, 1]))
        image[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1] = COLOURS[k]
    return image


def visible(pose: np.ndarray, radius: int = 1) -> list[int]:
    """Points inside the image whose pixel no nearer square covers."""
    projected = project(pose)
    return [
        k
        for k, (u, v, z) in enumerate(projected)
        if radius < u < WIDTH - radius
        and radius < v < HEIGHT - radius
        and all(
            np.abs(np.floor(p[:2]) - np.floor([u, v])).max() > radius + 1
            for j, p in enumerate(projected)
            if j != k and p[2] < z
        )
    ]


def write_scene(
    folder: Path, views: int | Sequence[int] = 5, seed: int = 0, radius: int = 1, truth: bool = False
) -> np.ndarray:
    """One scene folder; returns the poses of its views."""
    numbers = range(views) if isinstance(views, int) else views
    c2w = poses(len(numbers), seed)
    kinds = ("rgb", "pose", "depth", "mask") if truth else ("rgb", "pose")
    for kind in kinds:
        (folder / kind).mkdir(parents=True)
    for number, pose in zip(numbers, c2w, strict=True):
        image = draw(pose, radius)
        Image.fromarray(image).save(folder / "rgb" / f"{number:06d}.png")
        (folder / "pose" / f"{number:06d}.txt").write_text(" ".join(map(repr, pose.ravel().tolist())))
        if truth:
            mask = (image != 255).any(-1)
            Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "mask" / f"{number:06d}.png")
            np.savez_compressed(folder / "depth" / f"{number:06d}.npz", depth=np.where(mask, 1.3, 0).astype("f4"))
    (folder / "intrinsics.txt").write_text(f"{F} {CX} {CY} 0.\n0. 0. 0.\n1.\n{HEIGHT} {WIDTH}\n")
    return c2w


def write_srn(
    root: Path, scenes: dict[str, int] | None = None, views: int | Sequence[int] = 5, category: str = "cars", **kwargs
) -> dict[str, np.ndarray]:
    """Splits with so many scenes each; returns the poses by "<split>/<scene>"."""
    written = {}
    for split, count in (scenes or {"train": 3, "val": 1, "test": 2}).items():
        for k in range(count):
            seed = len(written)
            folder = root / f"{category}_{split}" / f"scene{k}"
            written[f"{split}/scene{k}"] = write_scene(folder, views, seed=seed, **kwargs)
    return written
