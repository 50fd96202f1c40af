"""Importance samples drawn from what an earlier rendering saw."""

import math
from itertools import pairwise

import pytest
import torch

from model_fixtures import input_cameras, look_at
from nerfdiff.cameras import Cameras, Rays
from nerfdiff.render.renderer import Renderer
from nerfdiff.render.sampling import KEPT

NEAR, FAR, N = 0.8, 1.8, 5


def bundle() -> Rays:
    directions = 0.1 * torch.randn(1, N, 3, generator=torch.Generator().manual_seed(3))
    directions[..., 2] = 1
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return Rays(torch.zeros(1, N, 3), directions, torch.full((1, N), NEAR), torch.full((1, N), FAR))


def blobs(points: torch.Tensor, directions: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    x, y, z = points.unbind(-1)
    density = 30 * torch.exp(-60 * ((z - 1.2) ** 2 + x**2 + (y - 0.05) ** 2)) + 4 * torch.sin(9 * z + x).square()
    return torch.sigmoid(torch.stack([5 * x, 5 * y, 8 * (z - 1.3)], -1)), density


def drawn_by_walking(weights: list[float], quantiles: list[float]) -> list[float]:
    """Inverse CDF over equal bins, a hundredth of it spread evenly, in Python's numbers."""
    bins, found = len(weights), []
    shares = [0.99 * w / sum(weights) + 0.01 / bins for w in weights]
    for u in quantiles:
        k, passed = 0, 0.0
        while k < bins - 1 and u > passed + shares[k]:
            passed += shares[k]
            k += 1
        found.append(NEAR + (FAR - NEAR) * (k + (u - passed) / shares[k]) / bins)
    return found


def composite_by_walking(field, origin, direction, distances: list[float], background: float):
    """Colour, opacity and depth of one ray at these distances."""
    edges = [NEAR, *(0.5 * (a + b) for a, b in pairwise(distances)), FAR]
    rgb, density = field((origin + torch.tensor(distances)[:, None] * direction)[None])
    colour, depth, through = [0.0] * 3, 0.0, 1.0
    for i, t in enumerate(distances):
        alpha = 1 - math.exp(-float(density[0, i]) * (edges[i + 1] - edges[i]))
        colour = [old + through * alpha * float(new) for old, new in zip(colour, rgb[0, i], strict=True)]
        depth += through * alpha * t
        through *= 1 - alpha
    return [c + through * background for c in colour], 1 - through, depth / (1 - through)


@pytest.mark.parametrize("chunk", [10**6, 9])
@pytest.mark.parametrize("jittered", [True, False])
def test_given_weights_decide_where_samples_fall(jittered, chunk):
    """Against a walk along each ray, with weights that have nothing to do with the field."""
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(1, N, 6, generator=g).pow(6).to(KEPT)
    jitter = torch.rand(1, N, 6 + 4, generator=g) if jittered else None
    seen = []

    def counted(points, directions):
        seen.append(points.shape[1])
        return blobs(points)

    rays = bundle()
    out = Renderer(6, 4, 0.3, chunk).render(counted, rays, jitter, weights)
    assert sum(seen) == N * 10 and len(seen) == (1 if chunk > 9 else N)  # one look at all samples of a chunk
    for ray in range(N):
        offsets = [0.5] * 10 if jitter is None else jitter[0, ray].tolist()
        uniform = [NEAR + (FAR - NEAR) * (i + offsets[i]) / 6 for i in range(6)]
        drawn = drawn_by_walking(weights[0, ray].tolist(), [(j + offsets[6 + j]) / 4 for j in range(4)])
        expected = composite_by_walking(
            blobs, rays.origins[0, ray], rays.directions[0, ray], sorted(uniform + drawn), 0.3
        )
        assert out.rgb[0, ray].tolist() == pytest.approx(expected[0], abs=1e-4)
        assert float(out.opacity[0, ray]) == pytest.approx(expected[1], abs=1e-4)
        assert float(out.depth[0, ray]) == pytest.approx(expected[2], abs=1e-4)


def test_kept_weights_are_those_of_a_walk_over_equal_bins_and_change_no_picture():
    renderer, rays = Renderer(7, 5, 1.0, 10**6), bundle()
    out, plain = renderer.render(blobs, rays, keep_coarse=True), renderer.render(blobs, rays)
    assert plain.coarse is None and torch.equal(out.rgb, plain.rgb) and torch.equal(out.depth, plain.depth)
    assert out.coarse.dtype == KEPT and out.coarse.shape == (1, N, 7)
    for ray in range(N):
        through, length = 1.0, (FAR - NEAR) / 7
        for i in range(7):
            point = rays.origins[0, ray] + (NEAR + (i + 0.5) * length) * rays.directions[0, ray]
            alpha = 1 - math.exp(-float(blobs(point)[1]) * length)
            assert float(out.coarse[0, ray, i]) == pytest.approx(through * alpha, abs=1e-3)
            through *= 1 - alpha
    assert Renderer(7, 0, 1.0, 10**6).render(blobs, rays, keep_coarse=True).coarse is None


@pytest.mark.parametrize("background", [1.0, None])
def test_the_same_field_looks_the_same_with_its_own_weights(background):
    renderer, rays = Renderer(16, 16, background, 10**6), bundle()
    first = renderer.render(blobs, rays, keep_coarse=True)
    again = renderer.render(blobs, rays, coarse=first.coarse)
    for name in ("rgb", "opacity", "depth"):  # half precision moves samples a little
        torch.testing.assert_close(getattr(again, name), getattr(first, name), atol=1e-3, rtol=0)


def test_rays_that_met_nothing_or_no_numbers_are_sampled_evenly():
    renderer, rays = Renderer(8, 8, 1.0, 10**6), bundle()
    even = renderer.render(blobs, rays, coarse=torch.full((1, N, 8), 0.1))
    for value in (0.0, float("nan")):
        out = renderer.render(blobs, rays, coarse=torch.full((1, N, 8), value))
        torch.testing.assert_close(out.rgb, even.rgb)


def test_weights_are_kept_in_parts_and_in_mixed_precision():
    rays = bundle()
    whole = Renderer(4, 4, 1.0, 10**6).render(blobs, rays, keep_coarse=True)
    with torch.autocast("cpu", torch.bfloat16):
        parts = Renderer(4, 4, 1.0, 9).render(blobs, rays, keep_coarse=True)
    assert parts.coarse.dtype == KEPT
    torch.testing.assert_close(parts.coarse, whole.coarse, atol=0.02, rtol=0)


def test_whole_views_keep_weights_by_pixel():
    source = input_cameras(1, 3, 5)
    cameras = Cameras(torch.stack([torch.eye(4), look_at((0.9, -0.4, 0.7))])[None], source.K.expand(1, 2, 3, 3), 3, 5)
    near, far = torch.tensor([NEAR]), torch.tensor([FAR])
    coarse = Renderer(4, 4, 1.0, 10**6).render_views(blobs, cameras, near, far, keep_coarse=True).coarse
    assert coarse.shape == (1, 2, 3, 5, 4)
    rays = cameras.rays(near[:, None], far[:, None])
    pixel = Rays(*(part.expand(1, 2, 3, 5, *part.shape[4:])[:, 1, 2, 3][:, None] for part in vars(rays).values()))
    alone = Renderer(4, 4, 1.0, 10**6).render(blobs, pixel, keep_coarse=True).coarse
    torch.testing.assert_close(coarse[0, 1, 2, 3], alone[0, 0], atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"coarse": torch.ones(1, N, 3)}, r"\(1, 5, 3\), expected \(1, 5, 4\)"),
        ({"coarse": torch.ones(1, N, 4), "keep_coarse": True}, "not jittered"),
        ({"jitter": torch.zeros(1, N, 8), "keep_coarse": True}, "not jittered"),
    ],
)
def test_what_cannot_be_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        Renderer(4, 4, 1.0, 10**6).render(blobs, bundle(), **given)
