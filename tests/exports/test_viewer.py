"""The page that draws a field: in a headless browser it shows what the renderer shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import nerfdiff
from nerfdiff.exports.viewer import write_viewer
from nerfdiff.exports.views import over, render_rgba
from nerfdiff.inputs import ASSETS

SAMPLES, HEIGHT = 64, 64


@pytest.fixture(scope="module")
def saved():
    return nerfdiff.load("demo", "cpu").distil(ASSETS / "pictures" / "wagon.png", strategy="none").saved


@pytest.fixture(scope="module")
def page(saved, open_page, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "viewer.html"
    write_viewer(path, saved, saved.stands, "a <car>", cells=24, samples=SAMPLES)
    return open_page(path)


def drawn(page, azimuth: float, elevation: float | None) -> torch.Tensor:
    """The page's picture over white [3, height, width]."""
    values = page.evaluate(f"([a, e]) => renderAt(a, e, {HEIGHT}, {SAMPLES})", [azimuth, elevation])
    rgba = torch.tensor(values, dtype=torch.float32).reshape(HEIGHT, HEIGHT, 4).movedim(-1, 0) / 255
    return rgba[:3] + 1 - rgba[3:]


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, None), (120.0, 10.0), (250.0, 50.0)])
def test_it_shows_what_the_renderer_shows(saved, page, azimuth, elevation):
    evenly = replace(saved, renderer=replace(saved.renderer, uniform_samples=SAMPLES, importance_samples=0))
    at = None if elevation is None else torch.tensor([elevation])
    camera = saved.stands.around(saved.field.cameras, torch.tensor([azimuth]), at)
    truth = render_rgba(evenly, camera, HEIGHT)
    error = drawn(page, azimuth, elevation) - over(truth, 1.0)[0]
    assert -10 * torch.log10((error**2).mean()) > 38
    assert -10 * torch.log10((error**2)[:, truth[0, 3] > 0.5].mean()) > 35


def test_it_is_turned_by_hand_on_a_desk_and_on_a_phone(page):
    def state():
        return page.evaluate("[camera.azimuth, camera.elevation, camera.distance]")

    for width, height in ((1440, 900), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.click("#input")
        azimuth, elevation, distance = state()
        box = page.locator("#view").bounding_box()
        assert box["width"] <= width and box["y"] >= 0 and box["y"] + box["height"] <= height
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + box["width"] / 4, y + box["width"] / 9)
        page.mouse.up()
        assert state()[:2] == pytest.approx([azimuth - 45, elevation + 20], abs=0.5)
        page.mouse.wheel(0, 200)
        page.wait_for_function(f"camera.distance > {distance}")
        page.focus("#view")
        page.keyboard.press("ArrowRight")
        assert state()[0] == pytest.approx(azimuth - 53, abs=0.5)
        page.click("#input")
        assert state() == [azimuth, elevation, distance]
    assert page.title() == "a <car>"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.complaints == []


def test_depth_and_opacity_are_shown(page):
    colour = np.asarray(drawn(page, 0, None))
    pictures = []
    for kind in ("1", "2"):
        page.select_option("#shown", kind)
        pictures.append(np.asarray(drawn(page, 0, None)))
    page.select_option("#shown", "0")
    depth, opacity = pictures
    assert np.allclose(depth[0], depth[1], atol=0.01) and np.allclose(opacity[0], opacity[2], atol=0.01)
    assert np.abs(depth - colour).mean() > 0.02 and opacity.max() > 0.99 and opacity[:, 0, 0].max() < 0.02
