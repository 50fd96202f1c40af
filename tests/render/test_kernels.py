"""The fused renderer against the float64 reference: compiled where there is a GPU, else in Triton's interpreter."""

import os
import random

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton")

from fused_scenes import DEVICE, LAUNCHES, NAMES, Case, drawn_case, without_trials
from nerfdiff.render.kernels import passes
from nerfdiff.render.kernels.arguments import Bundle
from nerfdiff.render.kernels.tuning import INTERPRETED
from nerfdiff.render.sampling import compositing_weights, edges_between, importance_distances, in_bins, uniform_edges

on_gpu = pytest.mark.skipif(DEVICE.type == "cpu", reason="needs a GPU")

TUNED = {launch: launch._tuned for launch in LAUNCHES}
SEED = int(os.environ.get("KERNEL_SEED") or random.SystemRandom().randrange(2**31))
"""Of drawn cases, another in each run; set KERNEL_SEED to what a failure says to see it again."""
DRAWS = 6


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
    equal(case.fused(**settings), case.reference(), tolerance)


def equal(found, expected, tolerance: float = 1e-5, unclear: Tensor | None = None, told: object = "") -> None:
    """(Outputs, gradients); those of rays that are `unclear` are left out."""
    (outputs, gradients), (expected, expected_gradients) = found, expected

    def off(value: Tensor, truth: Tensor, of_rays: bool) -> Tensor:
        apart = (value - truth).abs()
        if of_rays and unclear is not None:
            apart = apart.masked_fill(unclear.reshape(*unclear.shape, *(1,) * (apart.ndim - 2)), 0)
        return apart.max()

    for name, value, truth in zip(("rgb", "opacity", "depth"), outputs, expected, strict=True):
        assert off(value, truth, True) <= tolerance, f"{name}; {told}"
    for name, value in gradients.items():
        truth = expected_gradients[name]
        scale = truth.abs().max().clamp_min(1e-6)
        assert off(value, truth, name in NAMES[5:]) <= 10 * tolerance * scale, f"{name}; {told}"


CASES = {
    "several blocks of rays and of samples": Case(n=5, uniform=5, importance=6, channels=17, hidden=20),
    "scenes, opaque background, no jitter": Case(scenes=2, background=None, jittered=False, plane=(1, 5)),
    "one sample of each kind": Case(uniform=1, importance=1, n=1, background=0.2),
}


@pytest.mark.parametrize("name", CASES)
def test_pictures_and_all_gradients_are_the_reference_s(name):
    compare(CASES[name])


@pytest.mark.parametrize("number", range(DRAWS))
def test_any_shapes_on_fresh_inputs(number, monkeypatch):
    """Where to look, then pictures and gradients: a rounding error in the first, where few rays meet anything, moves
    samples much further than it changes what is seen at them, so that each is compared given the other."""
    draw = random.Random(f"{SEED} {number}")
    case, wanted = drawn_case(draw), draw.sample(NAMES, draw.randint(1, len(NAMES)))
    samples = case.uniform + case.importance
    at_once = case.scenes * samples * draw.randint((case.n + 1) // 2, case.n)
    block = _interpreted_block(case, draw, monkeypatch)
    told = f"KERNEL_SEED={SEED}, draw {number}: {case}, {wanted}, {at_once} points at once, blocks {block}"
    settings = case.settings(points=at_once)

    if case.importance and not case.cached:
        weights = passes.coarse_weights(settings, *case.packed(), 0, case.n)
        looked, truth = first_look(case)
        off = (weights.cpu() - truth).abs().amax(-1).masked_fill(case.rounding_decides(looked), 0)
        assert off.max() <= 1e-5, f"coarse weights; {told}"
        distances = passes.merged_distances(settings, case.packed()[1], weights, 0).cpu()
    else:
        weights, distances = case.coarse, passes.distances_along(settings, *case.packed(), 0, case.n).cpu()
    if case.importance:
        weights = weights.cpu()
        bins, expected = second_look(case, weights, even=case.cached)
        # far apart where hardly anything is, or at quantiles that differ in more than their last digits: not both
        off = torch.minimum(
            (distances - expected).abs(), (cdf(bins, weights, distances) - cdf(bins, weights, expected)).abs()
        )
        assert off.max() <= 5e-6, f"distances; {told}"

    unclear = case.rounding_decides(distances)
    case.d_outputs = tuple(
        d.masked_fill(unclear.reshape(*unclear.shape, *(1,) * (d.ndim - 2)), 0) for d in case.d_outputs
    )
    equal(case.fused(wanted, points=at_once), case.reference(distances), unclear=unclear, told=told)


def cdf(edges: Tensor, weights: Tensor, distances: Tensor, floor: float = 1e-2) -> Tensor:
    """The share of the importance samples that is drawn before distances, as `importance_distances` draws them."""
    weights, count = weights.double(), weights.shape[-1]
    total = weights.sum(-1, keepdim=True)
    share = torch.where(total > 1e-8, weights / total.clamp_min(1e-8), 1 / count)
    summed = torch.cat([torch.zeros_like(total), ((1 - floor) * share + floor / count).cumsum(-1)], -1)
    rays = zip(distances.flatten(0, 1), edges.flatten(0, 1), summed.flatten(0, 1), strict=True)
    return torch.from_numpy(np.stack([np.interp(*(x.numpy() for x in ray)) for ray in rays])).reshape(distances.shape)


def _interpreted_block(case: Case, draw: random.Random, monkeypatch) -> dict[str, int] | None:
    """Blocks of any shape, large enough that there are not too many: they come one after the other."""
    if not INTERPRETED:
        return None
    block = {"R": draw.choice((1, 2, 4, 8)), "S": draw.choice((4, 8, 16, 32))}
    samples = case.uniform + case.importance
    while block["R"] * block["S"] < 16 or case.scenes * -(-case.n // block["R"]) * -(-samples // block["S"]) > 5:
        block["R" if block["R"] < case.n else "S"] *= 2
    for launch in LAUNCHES:
        monkeypatch.setattr(launch, "_block", block)
    return block


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
    found = passes.merged_distances(case.settings(), case.packed()[1], weights.to(DEVICE), 0, even)
    assert (found.cpu() - second_look(case, weights, even)[1]).abs().max() < 2e-5


def test_the_first_look_sees_the_reference_s_weights():
    case = Case(n=5, uniform=11, scenes=2)
    found = passes.coarse_weights(case.settings(), *case.packed(), 1, 3)
    assert (found.cpu() - first_look(case)[1][:, 1:4]).abs().max() < 1e-5


def first_look(case: Case) -> tuple[Tensor, Tensor]:
    """The reference's uniform samples, and their weights."""
    leaves = [leaf.double() for leaf in case.leaves]
    rays = case.rays(leaves)
    jitter = None if case.jitter is None else case.jitter[..., : case.uniform].double()
    distances = in_bins(uniform_edges(rays.near, rays.far, case.uniform), jitter)
    _, density = case.field(leaves)(rays.at(distances).flatten(1, 2))
    lengths = edges_between(distances, rays.near, rays.far).diff(dim=-1)
    return distances, compositing_weights(density.reshape(distances.shape), lengths)


def second_look(case: Case, weights: Tensor, even: bool) -> tuple[Tensor, Tensor]:
    """The edges of the bins that these weights are of, and all samples where the reference would have them."""
    near, far = case.ray_near.double(), case.ray_far.double()
    samples = [case.uniform, case.importance]
    uniform, drawn = (None, None) if case.jitter is None else case.jitter.double().split(samples, -1)
    edges = uniform_edges(near, far, case.uniform)
    first = in_bins(edges, uniform)
    bins = edges if even else edges_between(first, near, far)
    second = importance_distances(bins, weights.double(), case.importance, drawn)
    return bins, torch.cat([first, second], -1).sort(-1).values


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
