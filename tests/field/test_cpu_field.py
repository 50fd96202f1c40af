"""The CPU's way to a field's numbers, against the plain one in float64."""

import pytest
import torch

from model_fixtures import input_cameras
from nerfdiff.cameras import Rays
from nerfdiff.field.cpu_field import SKIP, Faint, Interpolate, scene_by_scene, suits
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render import renderer as renderer_module
from nerfdiff.render.renderer import Renderer, Rendering

NEAR, FAR = 0.8, 1.8


def field(batch: int, height: int, width: int, own_decoders: bool = False) -> TriplaneField:
    torch.manual_seed(0)
    decoder = Decoder(4, 8, density_shift=0.5, density_scale=6.0)
    if own_decoders:
        decoder = decoder.for_scenes(batch)
        with torch.no_grad():
            for parameter in decoder.parameters():
                parameter += 0.3 * torch.randn_like(parameter)
    planes = torch.randn(batch, 3, 4, height, width, requires_grad=True)
    cameras = input_cameras(batch, 12, 16)
    cameras.K[:, 0, 2] += torch.arange(batch)  # every scene its own camera
    bounds = torch.arange(batch) / 10
    return TriplaneField(Triplane(planes, cameras, NEAR + bounds, FAR + bounds), decoder)


def in_double(plain: TriplaneField) -> TriplaneField:
    planes, cameras = plain.triplane.planes.detach().double().requires_grad_(), plain.triplane.cameras
    triplane = Triplane(planes, cameras.to(torch.float64), plain.triplane.near.double(), plain.triplane.far.double())
    return TriplaneField(triplane, plain.decoder.for_scenes(1).double())


def rays(batch: int, n: int) -> Rays:
    """Some of them leave the frustum by its sides, some begin before it, some behind the camera."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.randn(batch, n, 3, generator=generator) * 0.3
    directions[..., 2] = 1
    directions = directions / directions.norm(dim=-1, keepdim=True)
    origins = 0.1 * torch.randn(batch, n, 3, generator=generator)
    origins[:, 1::3, 2] = -1.5
    return Rays(origins, directions, torch.full((batch, n), 0.5), torch.full((batch, n), 2.0))


def gradients(values: list[torch.Tensor], of: TriplaneField) -> list[torch.Tensor]:
    """Of one and the same random combination of the values, to planes and decoder."""
    generator = torch.Generator().manual_seed(1)
    total = sum((v.double() * torch.randn(v.shape, generator=generator, dtype=torch.float64)).sum() for v in values)
    return torch.autograd.grad(total, [of.triplane.planes, *of.decoder.parameters()])


def shown(rendering: Rendering) -> list[torch.Tensor]:
    return [rendering.rgb, rendering.opacity, rendering.depth]


def assert_same(values, expected, tolerance=2e-5):
    for value, reference in zip(values, expected, strict=True):
        scale = max(1.0, float(reference.detach().abs().max()))
        torch.testing.assert_close(value.double(), reference, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("own_decoders", [False, True])
@pytest.mark.parametrize(("height", "width"), [(6, 6), (5, 9), (1, 4), (7, 1)])
@pytest.mark.parametrize(("batch", "n"), [(1, 1), (3, 700), (1, 20_000)])
def test_values_and_gradients_are_those_of_the_plain_field(batch, n, height, width, own_decoders):
    fast = field(batch, height, width, own_decoders)
    plain = in_double(fast)
    points = 2 * torch.rand(batch, n, 3, generator=torch.Generator().manual_seed(2)) - torch.tensor([1, 1, 0.2])
    alone = [one(own) for one, own in zip(scene_by_scene(fast), points.split(1), strict=True)]
    values = [torch.cat(parts) for parts in zip(*alone, strict=True)]
    expected = plain(points.double())
    assert_same(values, expected)
    assert_same(gradients(values, fast), gradients(expected, plain))


@pytest.mark.parametrize("background", [1.0, None])
@pytest.mark.parametrize("chunk", [10**6, 300])
@pytest.mark.parametrize(("batch", "n"), [(1, 1), (2, 70)])
def test_renderings_and_gradients_are_those_of_the_plain_field(batch, n, chunk, background, monkeypatch):
    monkeypatch.setattr(renderer_module, "CACHED_POINTS", 200)
    fast, bundle = field(batch, 5, 9), rays(batch, n)
    plain, double = in_double(fast), Rays(*(part.double() for part in vars(bundle).values()))
    jitter = torch.rand(batch, n, 12, generator=torch.Generator().manual_seed(4))
    # importance samples are left out: where they fall is rounded differently in float64
    render = Renderer(12, 0, background, chunk).render
    assert suits(fast, bundle) and not suits(plain, double)
    values = shown(render(fast, bundle, jitter))
    expected = shown(render(plain, double, jitter.double()))
    assert_same(values, expected)
    assert_same(gradients(values[:2], fast), gradients(expected[:2], plain), 1e-4)


def test_importance_samples_as_well():
    fast, bundle = field(2, 6, 6), rays(2, 50)
    render = Renderer(8, 8, 1.0, 10**6).render
    with torch.no_grad():
        expected = render(fast.__call__, bundle)  # any other function is rendered as it is
        assert_same(shown(render(fast, bundle)), [value.double() for value in shown(expected)], 1e-4)


@pytest.mark.parametrize("chunk", [10**6, 300])
def test_samples_drawn_from_kept_weights_as_well(chunk, monkeypatch):
    monkeypatch.setattr(renderer_module, "CACHED_POINTS", 200)
    fast, bundle = field(2, 6, 6), rays(2, 50)
    render = Renderer(8, 8, 1.0, chunk).render
    with torch.no_grad():
        before = render(fast, bundle, keep_coarse=True)
        assert torch.equal(before.rgb, render(fast, bundle).rgb)
        kept = render(fast.__call__, bundle, keep_coarse=True).coarse
        torch.testing.assert_close(before.coarse, kept, atol=1e-3, rtol=0)
    jitter = torch.rand(2, 50, 16, generator=torch.Generator().manual_seed(4))
    values, expected = (shown(render(own, bundle, jitter, before.coarse)) for own in (fast, fast.__call__))
    assert_same(values, [value.double() for value in expected], 1e-4)
    assert_same(gradients(values[:2], fast), [g.double() for g in gradients(expected[:2], fast)], 1e-4)


def test_gradients_to_rays_take_the_plain_way():
    fast, bundle = field(1, 6, 6), rays(1, 5)
    bundle.origins.requires_grad_()
    assert not suits(fast, bundle)
    (gradient,) = torch.autograd.grad(Renderer(8, 0, 1.0, 10**6).render(fast, bundle).rgb.sum(), bundle.origins)
    assert gradient.abs().max() > 1e-3
    with torch.no_grad():
        assert suits(fast, bundle)


def test_interpolation_by_hand_and_its_gradient():
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(30, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    cells = torch.randint(0, 24, (7, 3), dtype=torch.int32, generator=generator)
    weights = torch.rand(7, 3, 4, dtype=torch.float64, generator=generator)
    corners = torch.tensor([0, 1, 5, 6], dtype=torch.int32)
    by_hand = [
        sum(weights[i, p, k] * table[cells[i, p] + corners[k]] for p in range(3) for k in range(4)) for i in range(7)
    ]
    torch.testing.assert_close(Interpolate.apply(table, cells, weights, corners), torch.stack(by_hand))
    assert torch.autograd.gradcheck(lambda table: Interpolate.apply(table, cells, weights, corners), (table,))


def test_not_a_number_stays_one_point():
    fast = field(1, 6, 6)
    points = torch.tensor([[[0.0, 0.0, 1.2], [float("nan"), 0.0, 1.2]]])
    _, density = scene_by_scene(fast)[0](points)
    assert torch.equal(density[0, :1], scene_by_scene(fast)[0](points[:, :1])[1][0]) and density[0, 1].isnan()


def outputs(function, *tensors, **given) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """The values of a function of table, weight and bias, and their gradients from `given`'s."""
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    values = function(*leaves)
    return values.detach(), list(torch.autograd.grad(values, leaves, given["from_"]))


@pytest.mark.parametrize("share", [1e-9, 1e-3, 0.3])
def test_what_a_faint_backward_pass_leaves_out_is_at_most_its_share_of_the_gradient(share):
    torch.manual_seed(3)
    table, weight, bias = torch.randn(3 * 25, 8), torch.randn(4, 8), torch.randn(4)
    one = scene_by_scene(field(1, 5, 5))[0]
    places = one._cells(2 * torch.rand(900, 3) - 1)
    # of a rendering: most are tiny, a third nothing at all
    gradient = torch.randn(900, 4) * 10 ** (-12 * torch.rand(900, 1))
    gradient[::3] = 0

    def exact(table, weight, bias):
        return torch.nn.functional.silu(Interpolate.apply(table, *places)) @ weight.mT + bias

    values, (of_table, of_weight, of_bias) = outputs(exact, table, weight, bias, from_=gradient)
    left = gradient.abs().amax(1) <= share * gradient.abs().amax(1).mean()
    assert left.sum() > 300 and gradient[left].abs().amax(1).sum() <= share * gradient.abs().amax(1).sum()
    _, (kept_table, kept_weight, _) = outputs(exact, table, weight, bias, from_=gradient * ~left[:, None])
    faint, found = outputs(lambda *own: Faint.apply(*own, *places, share), table, weight, bias, from_=gradient)
    torch.testing.assert_close(faint, values)
    for one, expected in zip(found, (kept_table, kept_weight, of_bias), strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-6)
    if share == 1e-9:  # as good as nothing is left out
        for one, expected in zip(found, (of_table, of_weight, of_bias), strict=True):
            torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-6)


def test_a_faint_backward_pass_keeps_nan_and_bears_nothing_at_all():
    one = scene_by_scene(field(1, 5, 5))[0]
    places = one._cells(2 * torch.rand(40, 3) - 1)
    given = torch.randn(75, 8), torch.randn(4, 8), torch.randn(4)
    nothing = outputs(lambda *own: Faint.apply(*own, *places, 0.1), *given, from_=torch.zeros(40, 4))[1]
    assert all(part.eq(0).all() for part in nothing)
    broken = torch.zeros(40, 4)
    broken[7, 2] = torch.nan
    assert all(
        part.isnan().any() for part in outputs(lambda *own: Faint.apply(*own, *places, 0.1), *given, from_=broken)[1]
    )


@pytest.mark.parametrize("halves", [False, True])
@pytest.mark.parametrize("own_decoders", [False, True])
def test_skipping_faint_samples_changes_no_rendering_and_next_to_no_gradient(own_decoders, halves):
    assert SKIP == {"none": 0.0, "faint": 1e-3}
    beams, found = rays(2, 60), {}
    for skip in SKIP:
        own = field(2, 6, 6, own_decoders)
        renderer = Renderer(8, 8, 1.0, 10_000, skip=skip)
        with torch.autocast("cpu", torch.bfloat16, enabled=halves):
            values = shown(
                renderer.render(own, beams, torch.rand(2, 60, 16, generator=torch.Generator().manual_seed(4)))
            )
            found[skip] = values, gradients(values, own)
        with torch.no_grad():
            found[skip] += (renderer.render(own, beams).rgb,)
    (values, exact, plain), (same, faint, still) = found.values()
    assert all(torch.equal(a, b) for a, b in zip(values, same, strict=True)) and torch.equal(plain, still)
    for one, expected in zip(faint, exact, strict=True):
        assert (one - expected).norm() < (6e-3 if halves else 2e-3) * expected.norm() and one.dtype == expected.dtype
    assert not torch.equal(faint[0], exact[0])  # something was skipped
