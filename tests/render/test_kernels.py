"""The fused renderer against the float64 reference: compiled where there is a GPU, else in Triton's interpreter."""

import pytest
import torch

pytest.importorskip("triton")

from fused_scenes import DEVICE, LAUNCHES, NAMES, Case, without_trials
from nerfdiff.render.compositing import compositing_weights
from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.arguments import Bundle, Fields
from nerfdiff.render.sampling import edges_between, importance_distances, in_bins, uniform_edges

on_gpu = pytest.mark.skipif(DEVICE.type == "cpu", reason="needs a GPU")

TUNED = {launch: launch._tuned for launch in LAUNCHES}


@pytest.fixture(autouse=True)
def _poisoned_memory(monkeypatch):
    """What is not written is NaN, so that it cannot pass for a result."""
    without_trials(monkeypatch)

    def poisoned(allocate):
        def fill(*args, **kwargs):
            tensor = allocate(*args, **kwargs)
            return tensor.fill_(float("nan") if tensor.is_floating_point() else torch.iinfo(tensor.dtype).min)

        return fill

    for name in ("empty", "empty_like"):
        monkeypatch.setattr(torch, name, poisoned(getattr(torch, name)))


def compare(case: Case, tolerance: float = 1e-5, **settings) -> None:
    """Every output, and every gradient relative to its greatest entry."""
    outputs, gradients = case.fused(**settings)
    expected, expected_gradients = case.reference()
    for name, value, truth in zip(("rgb", "opacity", "depth"), outputs, expected, strict=True):
        assert (value - truth).abs().max() <= tolerance, name
    for name, truth in expected_gradients.items():
        scale = truth.abs().max().clamp_min(1e-6)
        assert (gradients[name] - truth).abs().max() <= 10 * tolerance * scale, name


CASES = {
    "several blocks of rays and of samples": Case(n=5, uniform=5, importance=6, channels=17, hidden=20),
    "scenes, opaque background, no jitter": Case(scenes=2, background=None, jittered=False, plane=(1, 5)),
    "a decoder for each scene, grey": Case(scenes=2, own_decoders=True, background=0.5, plane=(4, 1)),
    "uniform samples only": Case(uniform=7, importance=0, background=None, n=1),
    "drawn from coarse weights of before": Case(scenes=2, n=3, uniform=5, importance=4, cached=True),
    "one sample of each kind": Case(uniform=1, importance=1, n=1, background=0.2),
}


@pytest.mark.parametrize("name", CASES)
def test_pictures_and_all_gradients_are_the_reference_s(name):
    compare(CASES[name])


def test_sums_in_a_fixed_order_are_the_same_sums():
    compare(Case(scenes=2, plane=(2, 3), background=None), ordered=True, points=2 * 6)  # a ray of each scene at a time


def test_rays_behind_the_camera_and_rays_that_miss_everything():
    case = Case(n=4, background=0.3)
    case.leaves[5][0, 0] = torch.tensor([0.0, 0.0, -5.0])  # ends behind the camera
    case.leaves[6][0, 1] *= -1  # looks back
    case.leaves[6][0, 2] = torch.tensor([1.0, 0.0, 0.0])  # sideways, before the near plane
    compare(case)
    (rgb, opacity, depth), gradients = case.fused()
    for ray in range(3):
        assert rgb[0, ray].tolist() == pytest.approx([0.3] * 3)
        assert float(opacity[0, ray]) == 0
        assert float(depth[0, ray]) == pytest.approx(float(case.ray_far[0, ray]))
        assert not gradients["origins"][0, ray].any()


@pytest.mark.filterwarnings("ignore:overflow encountered in exp")
@pytest.mark.parametrize("background", [1.0, None])
def test_empty_space(background):
    compare(Case(shift=-1e4, background=background, n=1))


@pytest.mark.parametrize("scale", [1e3, 1e12])
def test_solid_matter(scale):
    """Gradients of what is hidden are zero, however steep the density; the first sample's are the reference's."""
    compare(Case(shift=3.0, scale=scale, n=1), tolerance=1e-4)


def test_scenes_do_not_see_their_neighbours():
    together = Case(scenes=2, own_decoders=True, n=2)
    turned = Case(scenes=2, own_decoders=True, n=2)
    for values in (turned.leaves, turned.__dict__):
        for key, value in list(values.items() if isinstance(values, dict) else enumerate(values)):
            if isinstance(value, torch.Tensor):
                values[key] = value.flip(0)
    first, second = (c.render([leaf.to(DEVICE) for leaf in c.leaves], c.settings()) for c in (together, turned))
    for value, other in zip(first, second, strict=True):
        assert torch.equal(value, other.flip(0))


def test_what_is_kept_for_the_backward_pass_does_not_grow_with_samples():
    def kept(uniform, importance):
        case, total = Case(uniform=uniform, importance=importance, jittered=False, n=1), []
        with torch.autograd.graph.saved_tensors_hooks(lambda t: total.append(t.nbytes) or t, lambda t: t):
            case.render([leaf.to(DEVICE).requires_grad_() for leaf in case.leaves], case.settings())
        return sum(total)

    assert kept(2, 2) == kept(9, 8)


def test_rays_are_taken_so_many_at_a_time_that_memory_is_bounded():
    rays = torch.zeros(2, 10, 3)
    bundle = Bundle(rays, rays, rays[..., 0], rays[..., 0], None)
    assert bundle.chunks(2 * 4 * 8, 8) == [(0, 4), (4, 4), (8, 2)]
    assert bundle.chunks(1, 8) == [(i, 1) for i in range(10)]


def test_only_what_is_asked_for_is_computed(monkeypatch):
    case = Case(n=1)
    leaves = [leaf.to(DEVICE) for leaf in case.leaves]
    leaves[5].requires_grad_()
    asked, launch = [], passes._gradient

    def noted(*args, **kwargs):
        asked.append((kwargs["PLANES"], kwargs["DECODER"], kwargs["RAYS"]))
        launch(*args, **kwargs)

    monkeypatch.setattr(passes, "_gradient", noted)
    d_rgb = case.d_outputs[0].to(DEVICE)
    alone = torch.autograd.grad(case.render(leaves, case.settings())[0], leaves[5], d_rgb)[0].cpu()
    assert asked == [("none", False, True)]
    case.d_outputs = case.d_outputs[0], *(torch.zeros_like(d) for d in case.d_outputs[1:])
    truth = case.reference()[1]["origins"]
    assert (alone - truth).abs().max() <= 1e-4 * truth.abs().max()


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("jittered", [True, False])
def test_where_to_look_next_is_the_reference_s_choice(jittered, even):
    g = torch.Generator().manual_seed(4)
    case = Case(n=6, uniform=9, importance=7, jittered=jittered)
    weights = torch.rand(1, 6, 9, generator=g).pow(8)
    weights[0, 0] = 0  # nothing met
    weights[0, 1] = 0
    weights[0, 1, 4] = 1  # everything in one bin
    uniform, drawn = (None, None) if case.jitter is None else case.jitter.double().split([9, 7], -1)
    near, far = case.ray_near.double(), case.ray_far.double()
    edges = uniform_edges(near, far, 9)
    first = in_bins(edges, uniform)
    bins = edges if even else edges_between(first, near, far)
    second = importance_distances(bins, weights.double(), 7, drawn)
    expected = torch.cat([first, second], -1).sort(-1).values
    found = passes.merged_distances(case.settings(), bundle(case), weights.to(DEVICE), 0, even)
    assert (found.cpu() - expected).abs().max() < 2e-5


def test_the_first_look_sees_the_reference_s_weights():
    case = Case(n=5, uniform=11, scenes=2)
    leaves = [leaf.double() for leaf in case.leaves]
    rays = case.rays(leaves)
    edges = uniform_edges(rays.near, rays.far, 11)
    distances = in_bins(edges, case.jitter[..., :11].double())
    _, density = case.field(leaves)(rays.at(distances).flatten(1, 2))
    lengths = edges_between(distances, rays.near, rays.far).diff(dim=-1)
    expected = compositing_weights(density.reshape(distances.shape), lengths)[:, 1:4]
    found = passes.coarse_weights(case.settings(), fields(case), bundle(case), 1, 3)
    assert (found.cpu() - expected).abs().max() < 1e-5


def test_weights_are_kept_of_all_rays_as_the_reference_keeps_them():
    case = Case(scenes=2, n=3, uniform=5, jittered=False)
    leaves = [leaf.double() for leaf in case.leaves]
    expected = case.renderer.render(case.field(leaves), case.rays(leaves), keep_coarse=True)
    rays_at_once = 2 * 2 * (5 + 3)  # 2 of each scene
    found = case.render([leaf.to(DEVICE) for leaf in case.leaves], case.settings(points=rays_at_once), keep_coarse=True)
    assert found[3].dtype == expected.coarse.dtype
    assert (found[3].cpu().double() - expected.coarse.double()).abs().max() < 1e-3
    assert (found[0].cpu() - expected.rgb).abs().max() < 1e-5


def test_given_weights_are_looked_for_neither_forwards_nor_backwards(monkeypatch):
    def never(*_, **__):
        raise AssertionError("a coarse pass")

    monkeypatch.setattr(passes, "_coarse", never)
    compare(Case(n=3, cached=True), points=2 * 6)  # two rays at a time, then one
    with pytest.raises(AssertionError, match="a coarse pass"):
        Case(n=1).fused()


def fields(case: Case) -> Fields:
    planes, *decoder = (leaf.to(DEVICE) for leaf in case.leaves[:5])
    frustum = (value.to(DEVICE) for value in (case.K, case.near, case.far))
    return Fields(planes.movedim(2, -1).contiguous(), *frustum, *decoder)


def bundle(case: Case) -> Bundle:
    rays = (value.to(DEVICE) for value in (*case.leaves[5:], case.ray_near, case.ray_far))
    return Bundle(*rays, None if case.jitter is None else case.jitter.to(DEVICE))


def test_bf16_products_round_as_bf16_does():
    case = Case(channels=16, n=1)
    (rgb, *_), gradients = case.fused(precision="rounded" if DEVICE.type == "cpu" else "bf16")
    (exact, *_), exact_gradients = case.reference()
    assert 1e-5 < (rgb - exact).abs().max() < 2e-2
    for name, truth in exact_gradients.items():
        # a ray's gradient is what remains of its samples'
        assert 1e-5 < (gradients[name] - truth).norm() / truth.norm() < (0.2 if name in NAMES[5:] else 5e-2), name


BASE = {"channels": 48, "hidden": 64, "plane": (128, 128), "uniform": 64, "importance": 64}
REAL = {
    "base": {"n": 3000, **BASE},
    "odd": {"scenes": 3, "n": 777, "channels": 24, "plane": (32, 40), "importance": 33, "background": None},
    "decoders": {"scenes": 2, "n": 1001, "channels": 32, "plane": (64, 64), "importance": 0, "own_decoders": True},
    "widest": {"n": 500, "channels": 64, "plane": (16, 16), "importance": 21},
}
# of products, relative to sums of which gradients are made
TOLERANCES = {"ieee": 2e-5, "tf32x3": 2e-5, "tf32": 4e-3, "bf16": 3e-2}


@on_gpu
@pytest.mark.parametrize("trials", [False, True])
@pytest.mark.parametrize(
    ("name", "precision", "ordered"),
    [
        ("base", "tf32x3", False),
        ("base", "tf32", False),
        ("base", "bf16", False),
        ("base", "bf16", True),
        ("odd", "tf32", False),
        ("odd", "tf32x3", True),
        ("decoders", "bf16", False),
        ("widest", "tf32x3", False),
        ("widest", "bf16", True),
    ],
)
def test_compiled_kernels_at_real_sizes(name, precision, ordered, trials, monkeypatch):
    if trials and (name, precision, ordered) != ("base", "bf16", False):
        pytest.skip("trials of one size tell whether trials leave results alone")
    for launch in LAUNCHES if trials else ():
        monkeypatch.setattr(launch, "_tuned", TUNED[launch])
    case, tolerance = Case(**{"hidden": 64, "uniform": 48} | REAL[name]), TOLERANCES[precision]
    outputs, gradients = case.fused(precision=precision, ordered=ordered)
    expected, expected_gradients = case.reference()
    for value, truth in zip(outputs, expected, strict=True):
        assert (value - truth).abs().max() <= 5 * tolerance
    for key in ("planes", "w1", "b1", "w2", "b2"):
        truth = expected_gradients[key]
        assert (gradients[key] - truth).norm() <= 10 * tolerance * truth.norm(), key
    # a ray's slope jumps between texels, where rounding decides: most rays, not all
    for key in ("origins", "directions"):
        truth = expected_gradients[key]
        off = (gradients[key] - truth).norm(dim=-1) > 100 * tolerance * truth.norm(dim=-1).mean()
        assert off.float().mean() < 0.02, key


@on_gpu
def test_a_fixed_order_gives_the_same_bits_at_real_sizes():
    case = Case(n=4096, **BASE)
    (rgb, *_), first = case.fused(ordered=True, precision="bf16")
    (again, *_), second = case.fused(ordered=True, precision="bf16")
    assert torch.equal(rgb, again)
    assert all(torch.equal(first[name], second[name]) for name in first)
