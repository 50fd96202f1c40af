import numpy as np
import pytest

from closed_surface import assert_closed
from procedural import mesh

GREY = (0.5, 0.5, 0.5)


def a_slab():
    y, x = np.meshgrid(np.linspace(0, 2, 4), np.linspace(0, 3, 5), indexing="ij")
    upper = np.stack([x, y, np.full_like(x, 0.5)], axis=-1)
    return mesh.slab("slab", upper, upper - [0, 0, 0.5], GREY)


def a_tube(segments=64):
    return mesh.tube("tube", (1, 0, 0), (1, 0, 2), [0.5, 0.5], GREY, segments=segments)


@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (mesh.box("box", (1, 2, 3), (0.5, 2, 4), GREY), 4.0),
        (a_slab(), 3.0),
        # A regular n-gon of circumradius r has the area n/2 · r² · sin(2π/n).
        (a_tube(), 2 * 32 * 0.25 * np.sin(2 * np.pi / 64)),
        (mesh.panel("p", np.array([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)]), GREY, "matte", 0.02, 0.01), 0.06),
    ],
    ids=["box", "slab", "tube", "panel"],
)
def test_primitives_are_closed_and_have_the_volume_of_their_formula(part, volume):
    assert_closed(part)
    assert part.volume() == pytest.approx(volume)


def test_bevelled_box_keeps_its_extent_and_loses_only_its_edges():
    plain, bevelled = (mesh.box("box", (0, 0, 0), (2, 3, 4), GREY, bevel=b) for b in (0, 0.2))
    assert_closed(bevelled)
    assert np.allclose(bevelled.vertices.max(axis=0), [1, 1.5, 2])
    # Twelve edges lose less than a triangular prism of 0.2 × 0.2 each.
    assert 0 < plain.volume() - bevelled.volume() < 4 * (2 + 3 + 4) * 0.02 + 1e-9


def test_a_loft_faces_outwards_whichever_way_its_rings_run():
    ring = mesh.chamfered_rectangle(1, 1, 0.1, 0)
    lid = ring + np.array([0, 0, 1])
    up = mesh.loft("up", np.stack([ring, lid]), GREY)
    down = mesh.loft("down", np.stack([lid, ring]), GREY)
    assert_closed(up)
    assert_closed(down)
    assert up.volume() == pytest.approx(down.volume())


def test_mirrored_part_is_closed_and_lies_on_the_other_side():
    part = mesh.box("box", (1, 0, 0), (0.5, 1, 1), GREY, bevel=0.1)
    assert_closed(part.mirrored())
    assert np.allclose(part.mirrored().vertices[:, 0], -part.vertices[:, 0])


def test_panel_stands_out_on_the_side_from_which_its_corners_run_counter_clockwise():
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.0)])
    assert mesh.panel("p", corners, GREY, thickness=0.2, proud=0.1).vertices[:, 2].max() == pytest.approx(0.1)
    assert mesh.panel("p", corners[::-1], GREY, thickness=0.2, proud=0.1).vertices[:, 2].max() == pytest.approx(0.2)


def test_normalised_model_is_centred_with_unit_diagonal():
    boxes = (mesh.box("a", (5, 1, 1), (1, 1, 1), GREY), mesh.box("b", (9, 4, 2), (2, 1, 3), GREY))
    low, high = mesh.Model("boxes", boxes).normalised().bounds()
    assert np.allclose(low, -high)
    assert np.linalg.norm(high - low) == pytest.approx(1)
    assert np.allclose((high - low) / (high - low)[0], np.array([5.5, 4.0, 3.0]) / 5.5)
