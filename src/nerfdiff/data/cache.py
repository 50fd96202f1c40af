"""One file of a reader's decoded images: decode once, then read at the speed of the page cache.

    <folder>/<name>-<which reader>-<which files>/{images.u8, cameras.npz, scenes.json}

The name says what is in it, so a cache that is there is valid. It is built in a folder of another name,
under a lock, and renamed when it is whole. The index (scenes.json) keeps SHA-256 of itself and of the cameras, and
these come with that of each image, which each process checks when it first reads the image. Images are read by
position rather than through a memory map: that is 1.3 times as fast on pages mapped before and 4 times on others,
and a shortened file is an error and no crash.
"""

import errno
import hashlib
import io
import json
import logging
import os
import shutil
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path

import filelock
import numpy as np
import torch
from jaxtyping import UInt8
from rich.progress import track
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Listing, Scene, SceneReader
from nerfdiff.utils.errors import DataError, size_text
from nerfdiff.utils.hashes import sha256_file, sha256_values

FORMAT = "4"  # to be raised when the files above change their meaning, or readers decode other pixels
MAX_THREADS = 16  # decoding releases the interpreter lock, but not all the time
log = logging.getLogger(__name__)


class CachedReader:
    """A `SceneReader` that serves another reader's images and cameras from the cache.

    Ground-truth mask and depth are not cached: they are read through `reader` when asked for. May be sent to
    worker processes, forked or spawned.

    Args:
        reader: the split to copy; all its images must have one size.
        folder: where caches are kept; one takes 3·height·width bytes per image.
        name: the beginning of the cache's name.

    Raises:
        DataError: a scene cannot be read, image sizes differ, or the cache cannot be written. Nothing
            partial is left behind.
    """

    def __init__(self, reader: SceneReader, folder: str | Path, name: str):
        self.reader = reader
        self.identity, self.nearest_view = reader.identity, reader.nearest_view
        self._fingerprint = reader.fingerprint()
        prefix = f"{name}-{_short(FORMAT + reader.identity)}"
        self.path = Path(folder) / f"{prefix}-{_short(self._fingerprint)}"
        if not self.path.exists():
            _build(reader, self.path, prefix)
        try:
            index = json.loads((self.path / "scenes.json").read_text())
            arrays = (self.path / "cameras.npz").read_bytes()
            size = (self.path / "images.u8").stat().st_size
        except (OSError, ValueError) as error:
            raise self._damaged() from error
        if not isinstance(index, dict) or index.pop("sha256", None) != sha256_values(index):
            raise self._damaged()
        self._ids: list[str] = index["ids"]
        self._views = [tuple(views) for views in index["views"]]
        self._starts = _starts(self._views)
        self._shape = (self._starts[-1], 3, index["height"], index["width"])
        if size != np.prod(self._shape) or hashlib.sha256(arrays).hexdigest() != index["cameras"]:
            raise self._damaged()
        with np.load(io.BytesIO(arrays)) as arrays:
            self._c2w, self._K = (torch.from_numpy(arrays[key]) for key in ("c2w", "K"))
            self._bounds: list[list[float]] = arrays["bounds"].tolist()
            self._digests = arrays["digests"]
        self._checked = np.zeros(len(self._digests), bool)
        self._file: int | None = None

    def __len__(self) -> int:
        return len(self._ids)

    def fingerprint(self) -> str:
        return self._fingerprint

    def scene_id(self, index: int) -> str:
        return self._ids[index]

    def view_names(self, index: int) -> tuple[str, ...]:
        return self._views[index]

    def listing(self, index: int) -> Listing:
        return self.reader.listing(index)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        if truth:
            return self.reader.load(index, views, truth=True)
        names = self._views[index]
        positions = range(len(names)) if views is None else views
        rows = [self._starts[index] + range(len(names))[p] for p in positions]
        return Scene(
            id=self._ids[index],
            views=tuple(names[p] for p in positions),
            pixels=self._read(rows),
            cameras=Cameras(self._c2w[rows], self._K[rows], *self._shape[2:]),
            near=self._bounds[index][0],
            far=self._bounds[index][1],
        )

    def _read(self, rows: Sequence[int]) -> UInt8[Tensor, "rows 3 height width"]:
        if self._file is None:
            self._file = os.open(self.path / "images.u8", os.O_RDONLY)
            weakref.finalize(self, os.close, self._file)
        pixels = torch.empty((len(rows), *self._shape[1:]), dtype=torch.uint8)
        for image, row in zip(pixels.numpy(), rows, strict=True):
            if os.preadv(self._file, [image], row * image.nbytes) != image.nbytes:
                raise self._damaged()
            if not self._checked[row]:
                if hashlib.sha256(np.ascontiguousarray(image)).digest() != self._digests[row].tobytes():
                    raise self._damaged()
                self._checked[row] = True
        return pixels

    def _damaged(self) -> DataError:
        return DataError(f"{self.path}: the image cache is damaged; delete this folder, it is built anew")

    def __getstate__(self) -> dict:
        """Without the open file, which another process does not have."""
        return self.__dict__ | {"_file": None}


def _build(reader: SceneReader, path: Path, prefix: str) -> None:
    """Write the cache at `path`, unless another process does so first."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _acquire(filelock.FileLock(path.parent / f"{prefix}.lock")):
            if path.exists():
                return
            # Only after an earlier build was killed, or files changed, is there anything of this prefix
            for stale in path.parent.glob(f"{prefix}-*"):
                shutil.rmtree(stale, ignore_errors=True)
            partial = path.with_name(f"{path.name}.partial")
            try:
                _write(reader, partial)
                partial.rename(path)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
    except (OSError, NotImplementedError) as error:  # the latter is filelock's, where a disk has no locks
        raise DataError(
            f"{path}: the image cache cannot be written ({error}); make room there, set data.cache_dir to "
            "another folder, or set data.cache=false"
        ) from error


def _acquire(lock: filelock.FileLock) -> filelock.AcquireReturnProxy:
    try:
        return lock.acquire(timeout=1)
    except filelock.Timeout:
        log.info("another process holds %s while it builds the image cache; waiting for it", lock.lock_file)
        return lock.acquire()


def _write(reader: SceneReader, folder: Path) -> None:
    views = [reader.view_names(index) for index in range(len(reader))]
    starts = _starts(views)
    first = reader.load(0, [0])
    height, width = first.pixels.shape[-2:]
    image_bytes = first.pixels[0].numel()
    _require_space(folder.parent, starts[-1] * image_bytes)
    folder.mkdir()
    c2w, K = np.empty((starts[-1], 4, 4), np.float32), np.empty((starts[-1], 3, 3), np.float32)
    bounds = np.empty((len(views), 2))  # near and far of each scene
    digests = np.empty((starts[-1], hashlib.sha256().digest_size), np.uint8)

    def copy(index: int) -> None:
        scene = reader.load(index)
        if scene.pixels.shape[-2:] != (height, width):
            raise DataError(
                f"scene {scene.id} has images of {scene.cameras.height}x{scene.cameras.width}, scene "
                f"{first.id} of {height}x{width}; set data.image_size to resize all"
            )
        rows = slice(starts[index], starts[index + 1])
        c2w[rows], K[rows] = scene.cameras.c2w.numpy(), scene.cameras.K.numpy()
        bounds[index] = scene.near, scene.far
        pixels = scene.pixels.contiguous().numpy()
        for row, image in zip(digests[rows], pixels, strict=True):
            row[:] = np.frombuffer(hashlib.sha256(image).digest(), np.uint8)
        # written, not mapped: a full disk is then an error and no crash of the process
        with open(folder / "images.u8", "r+b") as file:
            file.seek(starts[index] * image_bytes)
            file.write(pixels.data)

    (folder / "images.u8").touch()
    with ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1)) as pool:
        try:
            copies = pool.map(copy, range(len(reader)))
            for _ in track(copies, f"decoding {starts[-1]} images once", total=len(reader)):
                pass
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    np.savez(folder / "cameras.npz", c2w=c2w, K=K, bounds=bounds, digests=digests)
    ids = [reader.scene_id(index) for index in range(len(reader))]
    index = {"ids": ids, "views": views, "height": height, "width": width}
    index |= {"cameras": sha256_file(folder / "cameras.npz")}
    index |= {"sha256": sha256_values(index)}
    (folder / "scenes.json").write_text(json.dumps(index))
    for file in folder.iterdir():
        with open(file, "rb") as handle:
            os.fsync(handle.fileno())


def _require_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(errno.ENOSPC, f"it takes {size_text(needed)}, and {size_text(free)} are free")


def _starts(views: Sequence[Sequence[str]]) -> list[int]:
    """Position of each scene's first image among all images, and at the end the number of images."""
    return [0, *accumulate(len(names) for names in views)]


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
