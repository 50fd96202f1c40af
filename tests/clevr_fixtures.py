"""Small datasets laid out as Clevr3D whose every pixel is known, by a projection that shares no code with nerfdiff.

The camera is built in metres, as a lens of 35 mm before a sensor of 32 by 24 mm.
"""

from pathlib import Path

import numpy as np
from PIL import Image

HEIGHT, WIDTH = 240, 320
LENS, SENSOR = 0.035, (0.032, 0.024)
NEAR, FAR = 4.0, 20.0
SETTINGS = {"near": NEAR, "far": FAR, "focal": 350.0, "stored_size": [HEIGHT, WIDTH]}

# no symmetry maps this set onto itself: a flipped or swapped axis puts a colour elsewhere
POINTS = np.array([[0.0, 0.0, 0.0], [2.5, 0.3, 0.2], [-0.5, 2.0, 1.0], [0.8, -1.9, 0.7], [-2.0, -1.5, 0.35]])
COLOURS = np.array([[0, 0, 0], [230, 20, 40], [20, 200, 30], [10, 40, 220], [240, 180, 10]], dtype=np.uint8)
FLOOR = np.array([120, 122, 125], dtype=np.uint8)
BALL, RADIUS = np.array([1.0, -0.4, 0.7]), 0.7


def positions(scenes: int, seed: int = 0) -> np.ndarray:
    """[scenes, 3, 3]: three cameras 120° apart about z, each at a height and distance of its own."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0, 2 * np.pi, (scenes, 1)) + np.arange(3) * 2 * np.pi / 3
    distance = rng.uniform(10, 12, (scenes, 3))
    elevation = np.radians(rng.uniform(24, 33, (scenes, 3)))
    flat = distance * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], -1)


def sensor_axes(position: np.ndarray) -> np.ndarray:
    """Columns: to the right of the sensor, down it, and into the scene."""
    ahead = -position / np.sqrt((position**2).sum())
    right = np.array([ahead[1], -ahead[0], 0.0])  # level
    right /= np.sqrt((right**2).sum())
    down = np.array(
        [
            ahead[1] * right[2] - ahead[2] * right[1],
            ahead[2] * right[0] - ahead[0] * right[2],
            ahead[0] * right[1] - ahead[1] * right[0],
        ]
    )
    assert down[2] < 0
    return np.stack([right, down, ahead], 1)


def project(position: np.ndarray, points: np.ndarray = POINTS, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """(u, v, z) of each point, one at a time."""
    rows = []
    for point in points:
        x, y, z = np.linalg.solve(sensor_axes(position), point - position)
        rows.append([(x / z * LENS / SENSOR[0] + 0.5) * width, (y / z * LENS / SENSOR[1] + 0.5) * height, z])
    return np.array(rows)


def directions(position: np.ndarray, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """[height, width, 3] unit directions through the pixel centres."""
    u = ((np.arange(width) + 0.5) / width - 0.5) * SENSOR[0]
    v = ((np.arange(height) + 0.5) / height - 0.5) * SENSOR[1]
    on_sensor = np.stack([*np.meshgrid(u, v), np.full((height, width), LENS)], -1)
    rays = on_sensor @ sensor_axes(position).T
    return rays / np.sqrt((rays**2).sum(-1, keepdims=True))


def hits(position: np.ndarray, height: int = HEIGHT, width: int = WIDTH) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray to the floor z = 0 or a ball on it, and whether it is the ball."""
    rays = directions(position, height, width)
    floor = -position[2] / rays[..., 2]
    along = rays @ (BALL - position)
    square = along**2 - ((BALL - position) ** 2).sum() + RADIUS**2
    ball = square > 0
    return np.where(ball, along - np.sqrt(np.where(ball, square, 0)), floor), ball


def draw(position: np.ndarray, height: int = HEIGHT, width: int = WIDTH, radius: int = 2) -> np.ndarray:
    """A plain floor, with a coloured square around the pixel that holds each point."""
    image = np.broadcast_to(FLOOR, (height, width, 3)).copy()
    projected = project(position, height=height, width=width)
    for k in np.argsort(-projected[:, 2]):
        u, v = np.floor(projected[k, :2]).astype(int)
        image[v - radius : v + radius + 1, u - radius : u + radius + 1] = COLOURS[k]
    return image


def write_clevr3d(
    root: Path, scenes: int = 4, truth: bool = True, height: int = HEIGHT, width: int = WIDTH, seed: int = 0
) -> np.ndarray:
    """Write all scenes; returns the camera positions. Scene k has k + 1 objects (of at most 6)."""
    camera_pos = positions(scenes, seed)
    shape = np.zeros((scenes, 6), np.int64)
    for scene in range(scenes):
        shape[scene, : min(scene + 1, 6)] = 1 + np.arange(min(scene + 1, 6)) % 3
    root.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(root / "metadata.npz", camera_pos=camera_pos, shape=shape, color=shape * 2)
    for kind in ("images", "depths", "masks") if truth else ("images",):
        (root / kind).mkdir()
    for scene in range(scenes):
        for view, position in enumerate(camera_pos[scene]):
            name = f"{scene}_{view}.png"
            rgba = np.dstack([draw(position, height, width), np.full((height, width), 255, np.uint8)])
            Image.fromarray(rgba).save(root / "images" / f"img_{name}", compress_level=1)
            if truth:
                distance, ball = hits(position, height, width)
                levels = np.minimum(np.round(distance * 0.025 * 65536), 65535).astype(np.uint16)
                Image.fromarray(levels).save(root / "depths" / f"depths_{name}", compress_level=1)
                Image.fromarray(ball * np.uint8(3)).save(root / "masks" / f"masks_{name}")
    return camera_pos
