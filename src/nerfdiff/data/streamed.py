"""A reader's scenes in a few large files, for data that no memory and no local disk holds.

    <folder or URL>/<split>/images/   LitData chunks of all views, in the order of scenes: CRC, camera, pixels
                           /scenes/   LitData chunks of all scenes, as JSON: id, views, first image, bounds, size

Everything is read by its position, so that the draws are those of any other reader: neither LitData's order nor its
state is used. A folder is mapped, a URL read in ranges of bytes; nothing of either stays in memory.
"""

import json
import logging
import os
import shutil
import struct
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Listing, MissingSplit, Scene, SceneReader
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.files import make_folder, publish

log = logging.getLogger(__name__)

FORMAT = 1
HEAD = struct.Struct("<I25f")
"""The bytes before an image's pixels: the CRC-32 of all that follows, its camera-to-world matrix and its intrinsics."""
KNOWN = 4096  # scenes that a process remembers
IMAGES, SCENES = "images", "scenes"


class StreamedReader:
    """A `SceneReader` of shards that `make_shards` wrote; without ground-truth masks and depth.

    Args:
        root: the folder, or a URL that LitData reads (s3://, gs://, …).
        split: its name.
        image_size: the size that is asked for; the images have that of their making.

    Raises:
        MissingSplit: the shards are without this split.
        ConfigError: the images have another size, or LitData is not installed.
    """

    nearest_view = False

    def __init__(self, root: str | Path, split: str, image_size: int | Sequence[int] | None = None):
        if find_spec("litdata") is None:
            raise ConfigError("data.shards needs LitData: install the project's extra `streaming`")
        self.root, self.split = str(root).rstrip("/"), split
        if "://" not in self.root and not Path(self.root, split, SCENES, "index.json").is_file():
            raise MissingSplit(f"{self.root}/{split}: no shards of this split; src/make_shards.py makes them")
        self._open: tuple[int, dict[str, Any]] | None = None
        self._facts = lru_cache(KNOWN)(self._read_facts)
        first = self._facts(0)
        if first.get("format") != FORMAT:
            raise DataError(f"{self.root}: shards of format {first.get('format')!r}, expected {FORMAT}; make them anew")
        self._size: tuple[int, int] = tuple(first["size"])
        self.identity, self.nearest_view = first["identity"], first["nearest_view"]
        side = [image_size] * 2 if isinstance(image_size, int) else image_size
        if side is not None and list(side) != list(self._size):
            raise ConfigError(
                f"data.shards={self.root} holds images of {self._size[0]}x{self._size[1]}, data.image_size asks for "
                f"{side[0]}x{side[1]}: make shards of that size, or leave data.image_size out"
            )

    def _items(self, kind: str) -> Any:
        """Open a part, in each process for itself: threads and mapped files do not outlive a fork."""
        if self._open is None or self._open[0] != os.getpid():
            self._open = os.getpid(), {}
        if kind not in self._open[1]:
            from litdata import StreamingDataset  # slow to import

            self._open[1][kind] = StreamingDataset(f"{self.root}/{self.split}/{kind}", shuffle=False)
        return self._open[1][kind]

    def _item(self, kind: str, index: int) -> bytes:
        try:
            return bytes(self._items(kind)[index])  # a view of the mapped file
        except Exception as error:  # of files, of the network, of whatever LitData trips over
            words = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DataError(f"{self.root}/{self.split}/{kind}: item {index} cannot be read ({words})") from error

    def _read_facts(self, index: int) -> dict[str, Any]:
        return json.loads(self._item(SCENES, index))

    def __len__(self) -> int:
        return len(self._items(SCENES))

    def fingerprint(self) -> str:
        return self._facts(0)["fingerprint"]

    def scene_id(self, index: int) -> str:
        return self._facts(index)["id"]

    def view_names(self, index: int) -> tuple[str, ...]:
        return tuple(self._facts(index)["views"])

    def listing(self, index: int) -> Listing:
        cameras = self.load(index).cameras
        return Listing(cameras.c2w.numpy().astype(np.float64), dict.fromkeys(self.view_names(index), ()))

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        facts = self._facts(index)
        names = facts["views"]
        positions = [range(len(names))[p] for p in (range(len(names)) if views is None else views)]
        pixels = np.empty((len(positions), 3, *self._size), np.uint8)
        cameras = np.empty((len(positions), 25), np.float32)
        for row, position in enumerate(positions):
            item = self._item(IMAGES, facts["first"] + position)
            crc, *cameras[row] = HEAD.unpack_from(item)
            if zlib.crc32(memoryview(item)[4:]) != crc:
                raise DataError(f"{self.root}: view {names[position]} of scene {facts['id']} is damaged; make it anew")
            pixels[row] = np.frombuffer(item, np.uint8, offset=HEAD.size).reshape(pixels.shape[1:])
        c2w, K = torch.from_numpy(cameras).split([16, 9], 1)
        return Scene(
            id=facts["id"],
            views=tuple(names[p] for p in positions),
            pixels=torch.from_numpy(pixels),
            cameras=Cameras(c2w.reshape(-1, 4, 4).clone(), K.reshape(-1, 3, 3).clone(), *self._size),
            near=facts["near"],
            far=facts["far"],
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without what another process opens for itself."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_open", "_facts")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_open": None, "_facts": lru_cache(KNOWN)(self._read_facts)}


def make_shards(reader: SceneReader, folder: Path, chunk_bytes: int, threads: int) -> bool:
    """Write a split's scenes at `folder`, unless they are there; true if it was written.

    Args:
        chunk_bytes: of a file.
        threads: that decode images.

    Raises:
        DataError: a scene cannot be read, sizes of images differ, the disk is full, or other scenes are there.
    """
    if (folder / SCENES / "index.json").is_file():
        there = StreamedReader(folder.parent, folder.name)
        if (there.identity, there.fingerprint()) != (reader.identity, reader.fingerprint()):
            raise DataError(
                f"{folder} holds shards of other scenes, or of files that changed: delete it, or choose out"
            )
        return False
    from litdata.streaming import Cache

    partial = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        make_folder(folder.parent)
        images, scenes = (Cache(str(partial / kind), chunk_bytes=chunk_bytes) for kind in (IMAGES, SCENES))
        common = {"format": FORMAT, "identity": reader.identity, "fingerprint": reader.fingerprint()}
        common |= {"nearest_view": reader.nearest_view}
        first = 0
        for index, scene in enumerate(track(_in_order(reader, threads), f"writing {folder}", total=len(reader))):
            height, width = scene.pixels.shape[-2:]
            if not index:
                size = height, width
            if size != (height, width):
                raise DataError(
                    f"scene {scene.id} has images of {height}x{width}, the first of {size[0]}x{size[1]}; set "
                    "data.image_size to resize all"
                )
            facts = {"id": scene.id, "views": scene.views, "first": first, "near": scene.near, "far": scene.far}
            scenes[index] = json.dumps(facts | {"size": size} | (common if not index else {})).encode()
            for pixels, c2w, K in zip(scene.pixels, scene.cameras.c2w, scene.cameras.K, strict=True):
                body = HEAD.pack(0, *c2w.flatten().tolist(), *K.flatten().tolist())[4:]
                body += pixels.contiguous().numpy().tobytes()
                images[first] = struct.pack("<I", zlib.crc32(body)) + body
                first += 1
        for kind in (images, scenes):
            kind.done()
            kind.merge()
        publish(partial, folder)
    except OSError as error:
        raise DataError(f"{folder}: the shards cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return True


def _in_order(reader: SceneReader, threads: int):
    """Scenes one after the other, a few of them decoded ahead."""
    with ThreadPoolExecutor(threads) as pool:
        ahead = [pool.submit(reader.load, index) for index in range(min(2 * threads, len(reader)))]
        for index in range(len(reader)):
            yield ahead.pop(0).result()
            if (following := index + 1 + len(ahead)) < len(reader):
                ahead.append(pool.submit(reader.load, following))
