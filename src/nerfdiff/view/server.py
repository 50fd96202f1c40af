"""A page, served by viser, that shows fields and renders them anew as they are turned."""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from nerfdiff.cli import command_words
from nerfdiff.evaluation.run import choose_device
from nerfdiff.exports.export import field_name
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field, load_steps
from nerfdiff.stopping import Stopped
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError
from nerfdiff.view.panes import SHOWN, Look, Pane, Pose, side_by_side

RESTS = 0.15
"""Seconds without a movement after which the scene is taken to rest."""
LEAST = 16
"""Pixels of a pane's smaller side that are rendered at least."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Settings:
    """Settings of the page.

    Args:
        height: pixels of a field's smaller side that are rendered when it rests.
        frame_seconds: that a picture may take while it moves, which says how small it is rendered.
        most_pixels: of a picture that is sent.
        samples: per ray at first, uniform and by importance; None: the fields' own.
        background: grey level behind the scene.
    """

    height: int
    frame_seconds: float
    most_pixels: int
    samples: tuple[int | None, int | None]
    background: float


class LiveViewer:
    """Serve fields until it is closed.

    Args:
        panes: the fields, at least one.
        host: `127.0.0.1` for this machine alone, `0.0.0.0` for all that reach it.
        port: the next one is taken where it is in use.

    Raises:
        ConfigError: viser is not installed.
    """

    def __init__(self, panes: Sequence[Pane], settings: Settings, host: str, port: int):
        viser = _viser()
        self.panes, self.settings = panes, settings
        self._rendering = threading.Lock()  # one picture at a time, of whatever client
        self._clients: dict[int, _Client] = {}
        with contextlib.redirect_stdout(None):  # it would say the address twice, in a box
            self.server = viser.ViserServer(host, port, label="NerfDiff", verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.scene.set_up_direction("+y")
        first = panes[0].pose()
        start = self.server.initial_camera
        start.fov, start.up = first.fov, (0.0, 1.0, 0.0)
        start.position, start.look_at = tuple(first.c2w[:3, 3].tolist()), (0.0, 0.0, 0.0)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    @property
    def url(self) -> str:
        host = self.server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{self.server.get_port()}"

    def close(self) -> None:
        clients = list(self._clients.values())
        for client in clients:
            client.end()
        self.server.stop()
        for client in clients:
            client.thread.join(timeout=60)

    def _connected(self, client) -> None:
        self._clients[client.client_id] = _Client(client, self.panes, self.settings, self._rendering)

    async def _left(self, client) -> None:
        if (gone := self._clients.pop(client.client_id, None)) is not None:
            gone.end()


class _Client:
    """One browser: its controls, its camera, and a thread that renders what they ask for."""

    def __init__(self, client, panes: Sequence[Pane], settings: Settings, rendering: threading.Lock):
        self.client, self.panes, self.settings, self._rendering = client, panes, settings, rendering
        self._changed, self._version, self._open = threading.Event(), 0, True
        self._moving = min(64, settings.height)
        self._rested: tuple | None = None
        """What the last picture at rest showed."""
        self._add_controls()
        client.camera.on_update(self._touch)
        self._touch()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def end(self) -> None:
        """Let the thread end with what it is rendering."""
        self._open = False
        self._touch()

    def _touch(self, _=None) -> None:
        self._version += 1
        self._changed.set()

    def _add_controls(self) -> None:
        gui, fields = self.client.gui, [pane.saved for pane in self.panes]
        self._shown = gui.add_dropdown("Show", SHOWN)
        self._dones = sorted({done for pane in self.panes for done in pane.steps})
        last = len(self._dones)
        self._step = gui.add_slider(
            "Step", 0, max(1, last), 1, max(1, last), visible=last > 0,
            hint="Of distillation; to the right: the scene as it is.",
        )  # fmt: skip
        uniform, importance = (
            self.settings.samples[number] or max(getattr(saved.renderer, name) for saved in fields)
            for number, name in enumerate(("uniform_samples", "importance_samples"))
        )
        self._uniform = gui.add_slider("Samples", 1, max(256, uniform), 1, uniform, hint="Per ray, evenly.")
        self._importance = gui.add_slider(
            "More samples", 0, max(256, importance), 1, importance, hint="Per ray, where the first saw something."
        )
        self._height = gui.add_slider(
            "Pixels", min(LEAST, self.settings.height), max(1024, self.settings.height), 16, self.settings.height,
            hint="That are rendered of a scene's smaller side when it rests.",
        )  # fmt: skip
        self._camera = gui.add_checkbox("Input camera", True, hint="Draw where the picture was taken from.")
        self._chosen = [gui.add_checkbox(pane.name, True) for pane in self.panes] if len(self.panes) > 1 else []
        back = gui.add_button("Back to the input camera")
        back.on_click(lambda _: self._go_back())
        self._said = gui.add_markdown("")
        controls = (self._shown, self._step, self._uniform, self._importance, self._height, self._camera)
        for control in (*controls, *self._chosen):
            control.on_update(self._touch)

    def _go_back(self) -> None:
        pose, camera = self.panes[0].pose(), self.client.camera
        with self.client.atomic():
            camera.up_direction = (0.0, 1.0, 0.0)
            camera.position, camera.look_at = pose.c2w[:3, 3].numpy(), np.zeros(3)
            camera.fov = pose.fov

    def _run(self) -> None:
        while self._open:
            self._changed.wait()
            self._changed.clear()
            try:
                self._show()
            except Exception as error:  # the page stays, and says so
                log.exception("a picture could not be made")
                self._said.content = f"No picture: {type(error).__name__}: {error}"

    def _show(self) -> None:
        """Send a picture that is made in time, and when nothing moves, one of full size."""
        version, started, whole = self._version, time.monotonic(), int(self._height.value)
        height, wanted = min(self._moving, whole), self._wanted()
        if not self._open or wanted == self._rested or not self._send(height, moving=height < whole, version=None):
            return
        self._rested = wanted if height == whole else None
        spent = max(1e-3, time.monotonic() - started)
        self._moving = int(np.clip(height * math.sqrt(self.settings.frame_seconds / spent), LEAST, 1024))
        if height < whole and not self._changed.wait(RESTS):
            self._rested = wanted if self._send(whole, moving=False, version=version) else None

    def _wanted(self) -> tuple:
        """All that a picture depends on."""
        camera = self.client.camera
        seen = *camera.wxyz, *camera.position, camera.fov, camera.image_height, camera.image_width
        return seen, self._look(), int(self._height.value), tuple(box.value for box in self._chosen)

    def _send(self, rendered: int, moving: bool, version: int | None) -> bool:
        """Render and send a picture; False where there is none to send, or one of another `version` is asked for."""
        started, camera = time.monotonic(), self.client.camera
        size = np.array([camera.image_height, camera.image_width])
        if size.min() < 1:
            return False
        size = np.maximum(1, (size * min(1.0, math.sqrt(self.settings.most_pixels / size.prod()))).astype(int))
        shown = [pane for number, pane in enumerate(self.panes) if not self._chosen or self._chosen[number].value]
        with self._rendering:
            picture = side_by_side(
                shown, self._pose(), self._look(), (int(size[0]), int(size[1])), rendered,
                lambda: not self._open or (version is not None and version != self._version),
            ) if shown else None  # fmt: skip
        if picture is None:
            if not shown:
                self.client.scene.set_background_image(None)
            return False
        self.client.scene.set_background_image(np.asarray(picture), "jpeg", jpeg_quality=70 if moving else 95)
        if not moving:
            self._said.content = f"{rendered} pixels in {time.monotonic() - started:.1f} s"
        return True

    def _pose(self) -> Pose:
        camera = self.client.camera
        w, x, y, z = (float(value) for value in camera.wxyz)
        c2w = torch.eye(4)
        c2w[:3, :3] = torch.tensor([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        c2w[:3, 3] = torch.from_numpy(np.asarray(camera.position)).float()
        return Pose(c2w, float(camera.fov))

    def _look(self) -> Look:
        position = int(self._step.value)
        done = self._dones[position] if position < len(self._dones) else None
        samples = int(self._uniform.value), int(self._importance.value)
        return Look(self._shown.value, done, *samples, self._camera.value, self.settings.background)


def read_panes(fields: Sequence[str], device: torch.device, source_elevation: float) -> list[Pane]:
    """Read fields and what lies beside them; names are those of their folders that differ.

    Raises:
        DataError: a file is no field.
    """
    panes = []
    for path, name in zip(map(Path, fields), names(fields), strict=True):
        saved = load_field(path)
        stands = saved.stands
        if stands is None:
            log.warning(
                "%s does not say how its scene stands: the camera is taken to look down from %g degrees "
                "(source_elevation)", path, source_elevation,
            )  # fmt: skip
            stands = Upright.assumed(float(saved.field.near[0] + saved.field.far[0]) / 2, source_elevation)
        panes.append(Pane(name, _on(saved, device), {n: _on(s, device) for n, s in load_steps(path).items()}, stands))
    return panes


def names(fields: Sequence[str]) -> list[str]:
    """Name fields as exports are; where two would have one name, by the parts of their paths that differ."""
    short = [field_name(Path(field)) for field in fields]
    if len(set(short)) == len(short):
        return short
    parts = [list(Path(field).absolute().with_suffix("").parts) for field in fields]
    if all(Path(field).name == FIELD for field in fields):
        parts = [path[:-1] for path in parts]
    while len({path[0] for path in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [path[1:] for path in parts]
    while len({path[-1] for path in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [path[:-1] for path in parts]
    joined = ["/".join(path) for path in parts]
    return [f"{name} ({number})" if joined.count(name) > 1 else name for number, name in enumerate(joined, 1)]


def _on(saved: SavedField, device: torch.device) -> SavedField:
    return replace(saved, field=saved.field.to(device).requires_grad_(False))


def open_viewer(cfg: DictConfig) -> LiveViewer:
    """Start what `conf/view.yaml` describes.

    Raises:
        UserError: no field, something that is none, or viser is not installed.
    """
    if not cfg.fields:
        raise ConfigError(f"name a field: {' '.join(command_words('view'))} field=out/car/{FIELD}")
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    panes = read_panes(cfg.fields, choose_device(cfg.device), cfg.source_elevation)
    samples = cfg.uniform_samples, cfg.importance_samples
    settings = Settings(cfg.height, cfg.frame_seconds, cfg.most_pixels, samples, cfg.background)
    return LiveViewer(panes, settings, cfg.host, cfg.port)


def view(cfg: DictConfig) -> None:
    """Serve fields until Ctrl-C.

    Raises:
        UserError: see `open_viewer`.
    """
    viewer = open_viewer(cfg)
    print(f"open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
    with contextlib.suppress(Stopped):
        threading.Event().wait()
    viewer.close()


def _viser():
    try:
        import viser
    except ImportError as error:
        raise ConfigError("view.py needs viser: pip install viser") from error
    return viser
