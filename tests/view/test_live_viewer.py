"""The live viewer, asked by a client that connects as a browser does: what it gets is what the renderer makes."""

import contextlib
import io
import math
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
import viser
import zstandard
from PIL import Image
from scipy.spatial.transform import Rotation
from websockets.sync.client import connect

from bars_scene import BARS, STANDS, bars_scene
from model_fixtures import look_at
from nerfdiff.cli import load_config
from nerfdiff.exports.views import over, render_rgba
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import FIELD, save_field, save_steps
from nerfdiff.results.pictures import colour_depth
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.view.panes import Pane, Pose, places
from nerfdiff.view.server import LiveViewer, Settings, names, open_viewer

SIZE, WIDE = 72, 96
SETTINGS = Settings(height=SIZE, frame_seconds=0.15, most_pixels=10**6, samples=(None, None), background=1.0)


class Browser:
    """Speaks viser's protocol; keeps what controls are called and the last pictures."""

    def __init__(self, port: int):
        self.socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None)
        self.labels: dict[str, str] = {}
        self.pictures: list[np.ndarray] = []

    def look(self, pose, width=SIZE, height=SIZE):
        """Move the camera."""
        position = pose.c2w[:3, 3]
        message = {
            "wxyz": Rotation.from_matrix(pose.c2w[:3, :3].numpy()).as_quat(scalar_first=True).tolist(),
            "position": position.tolist(),
            "fov": pose.fov,
        }
        more = {"near": 0.01, "far": 1000.0, "image_height": height, "image_width": width}
        self._send("ViewerCameraMessage", message | more | {"look_at": [0.0] * 3, "up_direction": [0.0, 1.0, 0.0]})

    def set(self, label, value):
        self._send("GuiUpdateMessage", {"uuid": self.labels[label], "updates": {"value": value}})

    def picture(self) -> np.ndarray:
        """Wait for the last picture of a scene at rest [height, width, 3]; it is packed less than those in motion."""
        self.pictures, rests = [], False
        while True:
            try:
                received = self._receive(0.5 if rests else 15.0)
            except TimeoutError:
                if rests:
                    return self.pictures[-1]
                raise
            for message, data in received:
                if label := message.get("props", {}).get("label"):
                    self.labels[label] = message["uuid"]
                elif message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                    image = Image.open(io.BytesIO(data(message["rgb_data"])))
                    self.pictures.append(np.asarray(image) / 255)
                    rests = max(image.quantization[0]) < 20

    def _receive(self, seconds=15.0):
        raw = self.socket.recv(timeout=seconds)
        length = int.from_bytes(raw[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))
        at, buffers = 16 + length, []
        for size in content["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(raw[at : at + size])
            at += size

        def data(value):
            return value if isinstance(value, bytes) else buffers[value["__binary_index"]]

        return [(message, data) for message in content["messages"]]

    def _send(self, kind, values):
        self.socket.send(msgspec.msgpack.encode({"type": kind} | values))


@contextlib.contextmanager
def served(*panes, settings=SETTINGS):
    viewer = LiveViewer(panes, settings, "127.0.0.1", 0)
    browser = Browser(viewer.server.get_port())
    try:
        yield browser
    finally:
        browser.socket.close()
        viewer.close()


class Empty(RefinedField):
    def field(self):
        return lambda points, directions=None: (torch.zeros_like(points), torch.zeros(points.shape[:-1]))


@pytest.fixture(scope="module")
def pane():
    """The bars, and an empty field from before the first step."""
    saved = bars_scene()
    empty = replace(saved, field=Empty(saved.field.triplane, saved.field.decoder))
    return Pane("bars", saved, {0: empty}, STANDS)


@pytest.fixture(scope="module")
def browser(pane):
    """One that sees the bars from the input camera."""
    with served(pane) as browser:
        browser.look(pane.pose(), WIDE)
        browser.first = browser.picture()
        yield browser


def around(azimuth, elevation, distance=1.3):
    """A pose and a camera (always at 1.3) of the same view, by hand and by `Upright`."""
    a, e = math.radians(azimuth), math.radians(elevation)
    centre = distance * torch.tensor([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
    c2w = look_at(centre, (0, 0, 0), (0, -1, 0))
    source = bars_scene().field.cameras
    camera = STANDS.around(source, torch.tensor([azimuth]), torch.tensor([elevation]))
    return Pose(c2w, 2 * math.atan(source.height / 2 / float(source.K[0, 0, 0]))), camera


def psnr(picture, truth):
    """Of a picture and a tensor [3, height, width]."""
    error = picture - truth.movedim(0, -1).numpy()
    return -10 * math.log10((error**2).mean())


def test_from_the_input_camera_it_shows_the_renderers_picture(pane, browser):
    assert browser.first.shape == (SIZE, WIDE, 3)
    truth = over(render_rgba(pane.saved, pane.saved.field.cameras, SIZE), 1.0)[0]
    assert psnr(browser.first, truth) > 32
    for red in BARS[0][0], BARS[2][0]:  # both are seen
        assert (np.abs(browser.first - red).max(-1) < 0.15).mean() > 0.002


@pytest.mark.parametrize(("azimuth", "elevation"), [(90.0, 20.0), (200.0, 50.0)])
def test_turned_it_shows_the_renderers_picture(pane, browser, azimuth, elevation):
    pose, camera = around(azimuth, elevation)
    browser.look(pose, WIDE)
    browser.set("Input camera", False)
    assert psnr(browser.picture(), over(render_rgba(pane.saved, camera, SIZE), 1.0)[0]) > 32
    browser.set("Input camera", True)
    browser.picture()


def test_from_farther_away_the_input_camera_is_seen_where_it_stands(pane, browser):
    browser.look(around(90.0, 20.0, 3.5)[0], WIDE)
    drawn = browser.picture()
    browser.set("Input camera", False)
    difference = np.abs(drawn - browser.picture()).max(-1) > 0.3
    browser.set("Input camera", True)
    browser.picture()
    rows, columns = np.nonzero(difference)
    # it stands to the left at 1.3 from the middle, 30 degrees above the ground, and its pyramid opens to the middle
    focal = SIZE / 2 / math.tan(pane.pose().fov / 2)
    before = 3.5 - 1.3 * math.sin(math.pi / 6) * math.sin(math.pi / 9)
    left = WIDE / 2 - focal * 1.3 * math.cos(math.pi / 6) / before
    assert columns.min() == pytest.approx(left, abs=2)
    assert columns.max() < WIDE / 2 and rows.mean() < SIZE / 2 and 20 < difference.sum() < 600


def test_depth_opacity_samples_and_steps_are_shown(pane, browser):
    browser.look(pane.pose(), WIDE)
    browser.picture()
    camera = pane.saved.field.cameras.resized(SIZE, WIDE)
    with torch.no_grad():
        truth = pane.saved.field.render(pane.saved.renderer, camera[None])
    browser.set("Show", "opacity")
    assert psnr(browser.picture(), truth.opacity[0].expand(3, -1, -1)) > 32
    browser.set("Show", "depth")
    assert psnr(browser.picture(), colour_depth(truth.depth[0], 0.8, 1.8, truth.opacity[0])[0]) > 28
    browser.set("Show", "colour")
    browser.picture()
    browser.set("Samples", 5)
    browser.picture()
    browser.set("More samples", 0)
    few = replace(pane.saved, renderer=replace(pane.saved.renderer, uniform_samples=5, importance_samples=0))
    coarse = over(render_rgba(few, pane.saved.field.cameras, SIZE), 1.0)[0]
    picture = browser.picture()
    assert psnr(picture, coarse) > psnr(picture, truth.images[0, 0]) + 3
    browser.set("Samples", pane.saved.renderer.uniform_samples)
    browser.picture()
    browser.set("More samples", pane.saved.renderer.importance_samples)
    browser.picture()
    browser.set("Step", 0)
    nothing = browser.picture()
    assert nothing[20:].min() > 0.97 and nothing[:16, :60].min() < 0.7  # white, and which step it is
    browser.set("Step", 1)
    assert psnr(browser.picture(), truth.images[0, 0]) > 32


def test_it_is_small_while_it_moves_and_whole_when_it_rests(pane):
    with served(pane, settings=replace(SETTINGS, frame_seconds=1e-4, height=192)) as browser:
        for azimuth in (0.0, 10.0, 20.0):
            browser.look(around(azimuth, 30.0)[0], 192, 192)
        resting = browser.picture()
        assert len(browser.pictures) > 1 and all(one.shape == resting.shape for one in browser.pictures)
        camera = pane.camera(around(20.0, 30.0)[0], 192, 192)
        truth = over(render_rgba(pane.saved, camera, 192), 1.0)[0]
        assert psnr(resting, truth) > 32 > psnr(browser.pictures[0], truth) + 3


def test_fields_stand_side_by_side_from_one_camera_and_may_be_left_out(pane):
    other = Pane("nothing", pane.steps[0], {}, STANDS)
    with served(pane, other) as browser:
        browser.look(pane.pose(), 2 * WIDE)
        both = browser.picture()
        truth = over(render_rgba(pane.saved, pane.saved.field.cameras, SIZE), 1.0)[0]
        assert psnr(both[20:, :WIDE], truth[:, 20:]) > 32 and both[20:, WIDE:].min() > 0.97
        browser.set("nothing", False)
        assert psnr(browser.picture()[:, WIDE // 2 : 3 * WIDE // 2], truth) > 32
        browser.set("bars", False)
        browser.set("nothing", True)
        assert browser.picture().min() > 0.97


def test_files_are_served_with_their_steps(tmp_path, pane, capsys):
    plain = replace(pane.saved, field=pane.saved.field.alone(0))
    for strategy in ("ngd", "none"):
        save_field(tmp_path / strategy / "car" / FIELD, plain)
    save_steps(tmp_path / "ngd" / "car", plain, {0: plain.field, 8: plain.field})
    fields = [str(tmp_path / strategy / "car" / FIELD) for strategy in ("ngd", "none")]
    viewer = open_viewer(load_config("view", [f"field={','.join(fields)}", "port=0", "device=cpu"]))
    assert capsys.readouterr().out == ""  # `view` says the address
    browser = Browser(viewer.server.get_port())
    browser.look(viewer.panes[0].pose())
    browser.picture()
    assert [pane.name for pane in viewer.panes] == ["ngd", "none"] and {"ngd", "none"} <= set(browser.labels)
    assert [sorted(pane.steps) for pane in viewer.panes] == [[0, 8], []]
    assert torch.allclose(viewer.panes[0].steps[8].field.planes, plain.field.planes, atol=1e-3)
    assert viewer.panes[0].at(5)[0] == "ngd, step 0" and viewer.panes[0].at(None) == ("ngd", viewer.panes[0].saved)
    browser.socket.close()
    viewer.close()


def test_names_and_places():
    assert names(["out/car/field.safetensors", "out/van/field.safetensors"]) == ["car", "van"]
    assert names(["a.safetensors", "b/a.safetensors"])[1].endswith("b/a")
    assert names(["a/x/car/field.safetensors", "b/y/car/field.safetensors"]) == ["a/x", "b/y"]
    assert names(["a/field.safetensors"] * 2) == ["a (1)", "a (2)"]
    assert places(3, 100, 300) == [(0, 0, 100, 100), (100, 0, 100, 100), (200, 0, 100, 100)]
    assert places(2, 800, 390) == [(0, 0, 390, 400), (0, 400, 390, 400)]
    assert places(4, 100, 100)[3] == (50, 50, 50, 50)


def test_what_cannot_be_is_said(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"name a field: .*view.* field=out/car/field\.safetensors"):
        open_viewer(load_config("view", []))
    (tmp_path / "x.safetensors").write_text("no field")
    with pytest.raises(DataError, match=r"x\.safetensors: not a field"):
        open_viewer(load_config("view", [f"field={tmp_path / 'x.safetensors'}"]))
    for wrong in ("port=70000", "height=0", "frame_seconds=0"):
        with pytest.raises(ConfigError, match=wrong.partition("=")[0]):
            load_config("view", [wrong])
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match="needs viser: pip install viser"):
        LiveViewer([], SETTINGS, "127.0.0.1", 0)
