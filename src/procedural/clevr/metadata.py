"""Facts about each scene beside the pictures, and all of them together in `metadata.npz`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import atomic
from procedural.clevr.objects import COLOURS, MATERIALS, SHAPES, ClevrObject

SLOTS = 10  # CLEVR never has more objects


def facts_path(root: Path, index: int) -> Path:
    """Present once the scene is complete."""
    return Path(root) / ".scenes" / f"{index:06d}.json"


def scene_facts(objects: Sequence[ClevrObject], centres: Float[np.ndarray, "views 3"]) -> dict[str, Any]:
    """Return one scene's facts, which `write_metadata` collects."""
    return {"camera_pos": centres.tolist(), "objects": [item.facts() for item in objects]}


def write_metadata(root: Path) -> None:
    """Write `<root>/metadata.npz` of the scenes 0, 1, … up to the first one that is missing.

    Slots without an object hold 0; shapes, colours and materials count from 1 in the order of their lists.

    Raises:
        DataError: a scene's facts cannot be read, or the file cannot be written.
    """
    scenes = []
    while (path := facts_path(root, len(scenes))).exists():
        try:
            scenes.append(json.loads(path.read_text()))
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: not readable ({error}); delete it to render its scene anew") from error
    arrays = {
        "camera_pos": np.array([scene["camera_pos"] for scene in scenes]),
        "shape": _table(scenes, lambda o: 1 + SHAPES.index(o["shape"]), np.int64),
        "color": _table(scenes, lambda o: 1 + list(COLOURS).index(o["colour"]), np.int64),
        "material": _table(scenes, lambda o: 1 + MATERIALS.index(o["material"]), np.int64),
        "size": _table(scenes, lambda o: o["size"], np.float64),
        "rotation": _table(scenes, lambda o: o["rotation"], np.float64),
        "3d_coords": np.stack([_table(scenes, lambda o, a=axis: _place(o)[a], np.float64) for axis in range(3)], -1),
    }
    path = Path(root) / "metadata.npz"
    with atomic(path) as temporary:
        np.savez(temporary, **arrays)


def _place(facts: dict[str, Any]) -> tuple[float, float, float]:
    return facts["x"], facts["y"], float(ClevrObject(**facts).half_height)


def _table(scenes: Sequence[dict[str, Any]], value, dtype) -> np.ndarray:
    table = np.zeros((len(scenes), SLOTS), dtype)
    for row, scene in zip(table, scenes, strict=True):
        row[: len(scene["objects"])] = [value(item) for item in scene["objects"]]
    return table
