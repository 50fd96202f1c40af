import math

import pytest
import torch

from model_fixtures import input_cameras, look_at
from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render.renderer import Renderer

NEAR, FAR = 0.8, 1.8


def renderer(uniform=32, importance=32, chunk=10**7, background=1.0) -> Renderer:
    return Renderer(uniform, importance, background, chunk)


def rays(n: int, dtype=torch.float32) -> Rays:
    directions = torch.randn(1, n, 3, generator=torch.Generator().manual_seed(3), dtype=dtype) * 0.1
    directions[..., 2] = 1
    directions = directions / directions.norm(dim=-1, keepdim=True)
    near, far = (torch.full((1, n), value, dtype=dtype) for value in (NEAR, FAR))
    return Rays(torch.zeros(1, n, 3, dtype=dtype), directions, near, far)


def blobs(points: torch.Tensor, directions: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth field with structure along every axis."""
    x, y, z = points.unbind(-1)
    density = 30 * torch.exp(-60 * ((z - 1.2) ** 2 + x**2 + (y - 0.05) ** 2)) + 4 * torch.sin(9 * z + x).square()
    return torch.sigmoid(torch.stack([5 * x, 5 * y, 8 * (z - 1.3)], -1)), density


def naive_render(field, origin, direction, near, far, samples):
    """One ray in float64 with a loop, dense enough to stand for the integral."""
    step = (far - near) / samples
    colour, transmittance, depth = [0.0] * 3, 1.0, 0.0
    distances = near + (torch.arange(samples, dtype=torch.float64) + 0.5) * step
    rgb, density = field((origin.double() + distances[:, None] * direction.double())[None])
    for t, c, sigma in zip(distances.tolist(), rgb[0].tolist(), density[0].tolist(), strict=True):
        alpha = 1 - math.exp(-sigma * step)
        colour = [old + transmittance * alpha * new for old, new in zip(colour, c, strict=True)]
        depth += transmittance * alpha * t
        transmittance *= 1 - alpha
    opacity = 1 - transmittance
    return [c + transmittance for c in colour], opacity, depth / opacity


@pytest.mark.parametrize(("uniform", "importance", "tolerance"), [(64, 64, 1e-3), (24, 24, 6e-3), (128, 0, 1e-3)])
def test_few_samples_give_the_dense_integral(uniform, importance, tolerance):
    bundle = rays(6)
    out = renderer(uniform, importance).render(blobs, bundle)
    for i in range(6):
        colour, opacity, depth = naive_render(blobs, bundle.origins[0, i], bundle.directions[0, i], NEAR, FAR, 4000)
        assert out.rgb[0, i].tolist() == pytest.approx(colour, abs=tolerance)
        assert float(out.opacity[0, i]) == pytest.approx(opacity, abs=tolerance)
        assert float(out.depth[0, i]) == pytest.approx(depth, abs=tolerance)


def test_importance_samples_help_where_density_is_concentrated():
    def wall(points, directions=None):
        return torch.zeros_like(points), 300 * torch.exp(-((points[..., 2] - 1.31) ** 2) / (2 * 0.01**2))

    bundle = rays(16)
    truth = torch.tensor(
        [
            naive_render(wall, o, d, NEAR, FAR, 4000)[2]
            for o, d in zip(bundle.origins[0], bundle.directions[0], strict=True)
        ]
    )
    errors = {
        name: (renderer(*samples).render(wall, bundle).depth[0] - truth).abs().mean()
        for name, samples in {"both": (32, 32), "uniform": (64, 0)}.items()
    }
    assert errors["both"] < 0.5 * errors["uniform"]


def test_jittered_samples_are_unbiased():
    bundle = rays(1)
    expected = naive_render(blobs, bundle.origins[0, 0], bundle.directions[0, 0], NEAR, FAR, 4000)[0]
    generator = torch.Generator().manual_seed(0)
    many = Rays(*(part.expand(1, 2000, *part.shape[2:]) for part in vars(bundle).values()))
    jitter = torch.rand(1, 2000, 16, generator=generator)
    mean = renderer(8, 8).render(blobs, many, jitter).rgb.mean(1)[0]
    assert mean.tolist() == pytest.approx(expected, abs=0.02)


def test_constant_density_has_the_closed_form():
    def fog(points, directions=None):
        return torch.full_like(points, 0.25), torch.full(points.shape[:-1], 2.0)

    out = renderer(16, 16).render(fog, rays(3))
    opacity = 1 - math.exp(-2.0 * (FAR - NEAR))
    assert out.opacity.tolist() == [pytest.approx([opacity] * 3, abs=1e-5)]
    assert out.rgb[0, 0].tolist() == pytest.approx([0.25 * opacity + 1 - opacity] * 3, abs=1e-5)


def test_empty_space_shows_the_background_at_the_far_end():
    def nothing(points, directions=None):
        return torch.zeros_like(points), torch.zeros(points.shape[:-1])

    out = renderer(8, 8, background=0.3).render(nothing, rays(4))
    assert torch.equal(out.opacity, torch.zeros(1, 4))
    assert torch.equal(out.rgb, torch.full((1, 4, 3), 0.3))
    assert torch.equal(out.depth, torch.full((1, 4), FAR))


def test_without_a_background_the_farthest_sample_is_opaque():
    """Same as a wall of the field's own colour at the far end: against a naive loop over the samples."""

    def haze(points, directions=None):
        return points.abs().clamp(0, 1), 0.4 + points[..., 2] ** 2

    bundle = rays(4)
    out = renderer(8, 0, background=None).render(haze, bundle)
    width = (FAR - NEAR) / 8
    for k in range(4):
        colour, through = torch.zeros(3), 1.0
        for i in range(8):
            point = bundle.origins[0, k] + (NEAR + (i + 0.5) * width) * bundle.directions[0, k]
            rgb, density = haze(point)
            hit = 1.0 if i == 7 else 1 - math.exp(-float(density) * width)
            colour, through = colour + through * hit * rgb, through * (1 - hit)
        assert out.rgb[0, k].tolist() == pytest.approx(colour.tolist(), abs=1e-5)
    assert out.opacity.tolist() == [pytest.approx([1.0] * 4)]


def test_chunks_change_nothing_and_one_ray_works():
    bundle = rays(11)
    whole = renderer().render(blobs, bundle)
    for chunk in (1, 64 * 4, 64 * 10):
        torch.testing.assert_close(renderer(chunk=chunk).render(blobs, bundle).rgb, whole.rgb)
    one = Rays(*(part[:, :1] for part in vars(bundle).values()))
    torch.testing.assert_close(renderer().render(blobs, one).rgb, whole.rgb[:, :1])


def test_no_ray_at_all():
    none = Rays(*(part[:, :0] for part in vars(rays(1)).values()))
    assert renderer().render(blobs, none).rgb.shape == (1, 0, 3)


def coloured_points(points, directions=None):
    """Three small balls of different colours at places that share no symmetry (input camera space)."""
    rgb, density = torch.zeros_like(points), torch.zeros(points.shape[:-1])
    for centre, colour in BALLS:
        inside = (points - torch.tensor(centre)).norm(dim=-1) < 0.05
        rgb = torch.where(inside[..., None], torch.tensor(colour), rgb)
        density = torch.where(inside, 500.0, density)
    return rgb, density


BALLS = (
    ((0.25, 0.0, 1.3), (1.0, 0.0, 0.0)),
    ((0.0, 0.2, 1.2), (0.0, 1.0, 0.0)),
    ((-0.1, -0.1, 1.5), (0.0, 0.0, 1.0)),
)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (1.1, -0.5, 1.0), (-1.0, -0.6, 2.0)])
def test_known_points_appear_at_their_projections(centre):
    """A flipped or swapped axis, a transposed rotation or a mirrored image moves at least one ball."""
    source = input_cameras(1, 48, 64)
    camera = Cameras(look_at(centre)[None, None], source.K[None], 48, 64)
    near, far = torch.tensor([0.6]), torch.tensor([2.0])
    image = renderer(256, 0, background=1.0).render_views(coloured_points, camera, near, far).images[0, 0]
    for ball, colour in BALLS:
        # Projected by hand: world to camera is Rᵀ(x − C), then K.
        local = camera.c2w[0, 0, :3, :3].T @ (torch.tensor(ball) - torch.tensor(centre))
        u, v = (source.K[0, :2, :2] @ (local[:2] / local[2]) + source.K[0, :2, 2]).tolist()
        distance = (image - torch.tensor(colour)[:, None, None]).abs().sum(0)
        rows, columns = torch.nonzero(distance < 0.6, as_tuple=True)
        assert len(rows) >= 3
        assert float(columns.float().mean()) + 0.5 == pytest.approx(u, abs=0.8)
        assert float(rows.float().mean()) + 0.5 == pytest.approx(v, abs=0.8)


def triplane_field(planes, decoder):
    size = planes.shape[-1]
    camera = input_cameras(1, size, size).to(planes.dtype)
    near, far = (torch.tensor([value], dtype=planes.dtype) for value in (NEAR, FAR))
    return TriplaneField(Triplane(planes, camera, near, far), decoder)


@pytest.mark.parametrize("chunk", [10**6, 20])
def test_gradients_against_finite_differences(chunk):
    """To planes and decoder in float64, in one piece and recomputed in chunks. Importance samples are left out:
    where they fall follows the density, which finite differences see and the renderer by design does not."""
    torch.manual_seed(0)
    decoder = Decoder(2, 4, density_shift=0.0, density_scale=4.0).double()
    planes = torch.randn(1, 3, 2, 4, 4, dtype=torch.float64, requires_grad=True)
    bundle = rays(3, torch.float64)

    def image(planes, *parameters):
        return renderer(5, 0, chunk).render(triplane_field(planes, decoder), bundle).rgb

    assert torch.autograd.gradcheck(image, (planes, *decoder.parameters()), eps=1e-6, atol=1e-6)


def test_gradients_reach_planes_through_importance_samples_as_through_fixed_ones():
    """With the drawn distances held fixed, gradients equal those of rendering at just those distances."""
    torch.manual_seed(0)
    decoder = Decoder(2, 4, density_shift=0.0, density_scale=4.0).double()
    planes = torch.randn(1, 3, 2, 4, 4, dtype=torch.float64, requires_grad=True)
    bundle = rays(5, torch.float64)
    target = torch.rand(1, 5, 3, dtype=torch.float64)
    out = renderer(6, 6).render(triplane_field(planes, decoder), bundle)
    (gradient,) = torch.autograd.grad((out.rgb - target).square().sum(), planes)

    step = 1e-6 * torch.randn_like(planes)
    seen = []
    moved = triplane_field(planes.detach() + step, decoder)
    still = triplane_field(planes.detach(), decoder)

    def remember(points, directions=None):  # the points that the unmoved field chooses
        seen.append(points)
        return still(points)

    renderer(6, 6).render(remember, bundle)
    replay = iter(seen)
    frozen = renderer(6, 6).render(lambda points, _: _at(moved, still, points, next(replay), len(seen)), bundle)
    change = (frozen.rgb - target).square().sum() - (out.rgb - target).square().sum()
    assert change.item() == pytest.approx((gradient * step).sum().item(), rel=2e-2)


def _at(moved, still, points, remembered, calls):
    """The moved field at the points the unmoved one chose: importance samples barely move under a small step."""
    assert calls == 2
    torch.testing.assert_close(points, remembered, atol=1e-4, rtol=0)
    return moved(points)


def test_memory_kept_for_the_backward_pass_does_not_grow_with_samples():
    planes = torch.randn(1, 3, 8, 16, 16, requires_grad=True)
    decoder = Decoder(8, 16, density_shift=0.0, density_scale=4.0)

    def kept(samples: int) -> int:
        sizes = []
        hooks = torch.autograd.graph.saved_tensors_hooks(lambda t: sizes.append(t.numel()) or t, lambda t: t)
        with hooks:
            renderer(samples, samples, chunk=64).render(triplane_field(planes, decoder), rays(64)).rgb.sum()
        return sum(sizes)

    assert kept(32) <= kept(4)


def test_rays_stay_fp32_under_autocast():
    camera = Cameras(look_at((1.1, -0.5, 1.0))[None], input_cameras(1, 32, 32).K, 32, 32)
    expected = camera.rays(0.8, 1.8).directions
    with torch.autocast("cpu", torch.bfloat16):
        directions = camera.rays(0.8, 1.8).directions
        relative = camera.relative_to(camera).c2w
    assert torch.equal(directions, expected)
    torch.testing.assert_close(relative[0], torch.eye(4), atol=1e-6, rtol=0)
