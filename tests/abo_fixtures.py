"""Small datasets in both ABO layouts whose every pixel is known; shares no code with nerfdiff.

Geometry is worked out as Blender's manual states it: points in the camera's own axes (x right, y up, looking along
−z), a sensor in millimetres, and shifts that move the image on it.
"""

import json
import math
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

# no symmetry maps this set onto itself: a flipped or swapped axis puts a colour elsewhere
POINTS = np.array([[0.0, 0, 0], [0.8, 0.06, 0.16], [-0.16, 0.64, -0.32], [0.26, -0.4, 0.7], [-0.64, -0.48, -0.1]])
COLOURS = np.array([[0, 0, 0], [230, 20, 40], [20, 200, 30], [10, 40, 220], [240, 180, 10]], dtype=np.uint8)
DISTANCE = 4.9455  # of cameras in units of the object


def blender_poses(views: int, seed: int, centre, scale: float) -> np.ndarray:
    """Level camera-to-world matrices (x right, y up, z backward) that look at `centre`, in a z-up world."""
    rng = np.random.default_rng(seed)
    matrices = []
    for _ in range(views):
        azimuth, elevation = rng.uniform(0, 6.28), rng.uniform(-0.2, 1.3)
        back = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        position = np.asarray(centre) + back * DISTANCE * scale
        matrices.append(np.vstack([np.stack([right, np.cross(back, right), back, position], 1), [0, 0, 0, 1]]))
    return np.stack(matrices)


def project(pose: np.ndarray, camera: dict, height: int, width: int, points: np.ndarray) -> np.ndarray:
    """(u, v, depth) of each point, through a lens and sensor in millimetres."""
    rows = []
    vertical = camera["sensor_fit"] == "VERTICAL" or (camera["sensor_fit"] == "AUTO" and height > width)
    mm = camera["sensor_height"] if camera["sensor_fit"] == "VERTICAL" else camera["sensor_width"]
    angle = camera["angle_y"] if camera["sensor_fit"] == "VERTICAL" else camera["angle_x"]
    lens = mm / 2 / math.tan(angle / 2)
    pixels_per_mm = (height if vertical else width) / mm
    for point in points:
        x, y, z, _ = np.linalg.inv(pose) @ [*point, 1.0]
        on_sensor = np.array([lens * x / -z, lens * y / -z])  # mm from the optical axis, y up
        on_sensor -= np.array([camera["shift_x"], camera["shift_y"]]) * mm  # from the middle of the image
        rows.append([width / 2 + on_sensor[0] * pixels_per_mm, height / 2 - on_sensor[1] * pixels_per_mm, -z])
    return np.array(rows)


def draw(projected: np.ndarray, height: int, width: int, radius: int = 2) -> np.ndarray:
    """RGBA, transparent but for a square around the pixel of each point; nearer ones cover farther ones."""
    image = np.zeros((height, width, 4), np.uint8)
    for k in np.argsort(-projected[:, 2]):
        u, v = math.floor(projected[k, 0]), math.floor(projected[k, 1])
        image[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1] = [*COLOURS[k], 255]
    return image


def visible(projected: np.ndarray, height: int, width: int, radius: int = 2) -> list[int]:
    """Points inside the image whose pixel no nearer square covers."""
    return [
        k
        for k, (u, v, z) in enumerate(projected)
        if radius < u < width - radius
        and radius < v < height - radius
        and all(
            np.abs(np.floor(p[:2]) - np.floor([u, v])).max() > radius + 1
            for j, p in enumerate(projected)
            if j != k and p[2] < z
        )
    ]


def blender_camera(**changes) -> dict:
    """The release's camera: 40° over a square sensor."""
    camera = {"angle_x": math.radians(40), "angle_y": math.radians(40), "shift_x": 0.0, "shift_y": 0.0}
    return camera | {"sensor_height": 36.0, "sensor_width": 36.0, "sensor_fit": "HORIZONTAL"} | changes


def write_png16(path: Path, image: np.ndarray) -> None:
    """An 8-bit RGBA image as a 16-bit PNG, which Pillow does not write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], 16, 6, 0, 0, 0)
    rows = b"".join(b"\0" + (row.astype(">u2") * 257).tobytes() for row in image)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_item(
    folder: Path,
    views: int = 4,
    seed: int = 0,
    size: tuple[int, int] = (64, 64),
    camera: dict | None = None,
    bits: int = 8,
    poses=lambda blender: blender,
) -> dict:
    """One object of the 30-view renders; returns where it is and its Blender poses.

    Args:
        poses: what is written for a Blender matrix, to write another convention.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed + 1000)
    item = {"centre": rng.uniform(-0.3, 0.3, 3), "scale": rng.uniform(0.2, 2.0), "size": size}
    item["poses"] = blender_poses(views, seed, item["centre"], item["scale"])
    item["points"] = item["centre"] + item["scale"] * POINTS
    item["camera"] = camera or blender_camera()
    frames = []
    for k, pose in enumerate(item["poses"]):
        name = f"{folder.name}_{k:02d}"
        image = draw(project(pose, item["camera"], *size, item["points"]), *size)
        if bits == 16:
            write_png16(folder / f"{name}.png", image)
        else:
            Image.fromarray(image).save(folder / f"{name}.png")
        frames.append(
            {
                "file_path": f"/home/author/renders/photo_studio/{folder.name}/{name}",
                "transform_matrix": poses(pose).tolist(),
                "camera": item["camera"],
            }
        )
    values = {"obj_path": f"/models/{folder.name}.glb", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values, indent=4))
    return item


def write_renders(root: Path, items: int = 8, **kwargs) -> dict[str, dict]:
    """The 30-view layout with so many objects."""
    return {f"B{k:03d}": write_item(root / f"B{k:03d}", seed=k, **kwargs) for k in range(items)}


def write_exr(path: Path, values: np.ndarray, half: bool = False) -> None:
    """One channel, uncompressed, by the letter of the format."""

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    height, width = values.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = b"V\0" + struct.pack("<iIii", 1 if half else 2, 0, 1, 1) + b"\0"
    header = struct.pack("<ii", 20000630, 2) + b"".join(
        [
            attribute("channels", "chlist", channel),
            attribute("compression", "compression", b"\0"),
            attribute("dataWindow", "box2i", window),
            attribute("displayWindow", "box2i", window),
            attribute("lineOrder", "lineOrder", b"\0"),
            attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
            attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
            attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
            b"\0",
        ]
    )
    lines = [row.astype("<f2" if half else "<f4").tobytes() for row in values]
    start = len(header) + 8 * height
    offsets = [start + k * (8 + len(lines[0])) for k in range(height)]
    body = b"".join(struct.pack("<ii", k, len(line)) + line for k, line in enumerate(lines))
    path.write_bytes(header + struct.pack(f"<{height}Q", *offsets) + body)


def write_material_item(
    folder: Path, views: int = 12, seed: int = 0, size: int = 64, environments=("0", "1", "2"), half: bool = True
) -> dict:
    """One object of the 91-view set: 60°, colour beyond the mask is grey as if lit, depth along the camera's axis."""
    rng = np.random.default_rng(seed + 1000)
    item = {"centre": rng.uniform(-0.3, 0.3, 3), "scale": rng.uniform(0.2, 2.0), "size": (size, size)}
    item["poses"] = blender_poses(views, seed, item["centre"], item["scale"])
    item["points"] = item["centre"] + item["scale"] * POINTS
    item["camera"] = blender_camera(angle_x=math.radians(60))
    f = 443.40496826 * size / 512
    for part in ("segmentation", "depth", *(f"render/{e}" for e in environments)):
        (folder / part).mkdir(parents=True)
    entries = []
    for k, pose in enumerate(item["poses"]):
        projected = project(pose, item["camera"], size, size, item["points"])
        image = draw(projected, size, size)
        mask = image[..., 3]
        for number, e in enumerate(environments):
            lit = np.where(mask[..., None] > 0, image[..., :3], 90 + 20 * number).astype(np.uint8)
            Image.fromarray(lit).save(folder / f"render/{e}/render_{k}.jpg", quality=100, subsampling=0)
        Image.fromarray(mask).save(folder / f"segmentation/segmentation_{k}.jpg", quality=95)
        depth = np.full((size, size), 65504.0)
        for j in np.argsort(-projected[:, 2]):
            depth[(image[..., :3] == COLOURS[j]).all(-1) & (mask > 0)] = projected[j, 2]
        write_exr(folder / f"depth/depth_{k}.exr", depth, half)
        K = [f, 0, size / 2, 0, f, size / 2, 0, 0, 1]
        entries.append({"index": k, "pose": pose.ravel().tolist(), "K": K})
    rng.shuffle(entries)  # order in the file must not matter
    (folder / "metadata.json").write_text(json.dumps({"envs": list(range(len(environments))), "views": entries}))
    return item


def write_materials(root: Path, train: int = 5, test: int = 2, folder: str = "", **kwargs) -> dict[str, dict]:
    """The 91-view layout, with the release's table."""
    names = [f"B{k:03d}" for k in range(train + test)]
    items = {name: write_material_item(root / folder / name, seed=k, **kwargs) for k, name in enumerate(names)}
    rows = [f"{name},{'TRAIN' if k < train else 'TEST'},3,0_1_2" for k, name in enumerate(names)]
    (root / "train_test_split.csv").write_text("\n".join(["MODEL,SPLIT,N_SCENES,SCENES", *rows]) + "\n")
    return items
