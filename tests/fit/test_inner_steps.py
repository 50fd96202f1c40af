"""Inner steps against a plain loop that knows nothing of batches, fused optimizers or recorded steps."""

import copy
from contextlib import contextmanager, nullcontext

import pytest
import torch
import torch.nn.functional as F

from model_fixtures import input_cameras, look_at
from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.objective import FitLoss, Objective, ray_entropy
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.weight_average import WeightAverage
from nerfdiff.render.renderer import Renderer
from nerfdiff.utils.errors import ConfigError

RENDERER = Renderer(4, 3, 1.0, 4096)
SIZE, RAYS, STEPS = 16, 32, 5
IMAGES = torch.rand(1, 2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(2))


def fields(scenes: int, device="cpu") -> RefinedField:
    torch.manual_seed(1)
    near, far = torch.full((scenes,), 0.8), torch.linspace(1.7, 1.9, scenes)
    triplane = Triplane(torch.randn(scenes, 3, 4, SIZE, SIZE), input_cameras(scenes), near, far)
    return RefinedField(triplane, Decoder(4, 8, 0.0, 5.0)).to(device)


def views(scenes: int, count: int = 2) -> Cameras:
    places = torch.stack([look_at(place) for place in [(0.9, -0.4, 0.7), (-0.8, 0.3, 1.0)][:count]])
    K = input_cameras(1).K[0]
    return Cameras(places.expand(scenes, count, 4, 4), K.expand(scenes, count, 3, 3), SIZE, SIZE)


def inner_steps(
    field: RefinedField,
    images: torch.Tensor,
    rays: int = RAYS,
    record: bool = False,
    coarse: torch.Tensor | None = None,
    objective: Objective | None = None,
    average: WeightAverage | None = None,
) -> InnerSteps:
    device = field.planes.device
    batches = RayBatches(views(len(field)).to(device), field.near, field.far)
    batches.set_colours(images)
    if coarse is not None:
        batches.set_coarse(coarse)
    rates = torch.tensor([1e-2, 1e-3], device=device)
    optimizer = torch.optim.Adam(
        [{"params": [field.planes], "lr": rates[0]}, {"params": list(field.decoder.parameters()), "lr": rates[1]}],
        fused=True,
        capturable=device.type == "cuda",
    )
    generators = [torch.Generator(device).manual_seed(scene) for scene in range(len(field))]
    loss = FitLoss(objective, device)
    return InnerSteps(field, RENDERER, batches, optimizer, rays, generators, record, loss, average)


@pytest.mark.parametrize("remembered", [False, True])
def test_steps_are_those_of_a_plain_loop_over_each_scene_by_itself(remembered):
    field, images = fields(2), torch.rand(2, 2, 3, SIZE, SIZE)
    coarse = torch.rand(2, 2, SIZE, SIZE, RENDERER.uniform_samples).pow(4) if remembered else None
    references = [copy.deepcopy(field.alone(scene)) for scene in range(2)]
    losses = inner_steps(field, images, coarse=coarse).run(STEPS)
    for scene, reference in enumerate(references):
        draws = torch.Generator().manual_seed(scene)
        picked = torch.empty(STEPS, RAYS, dtype=torch.long).random_(2 * SIZE**2, generator=draws)
        jitter = torch.empty(STEPS, RAYS, RENDERER.samples_per_ray).uniform_(generator=draws)
        optimizer = torch.optim.Adam(
            [{"params": [reference.planes], "lr": 1e-2}, {"params": reference.decoder.parameters(), "lr": 1e-3}],
            foreach=False,
        )
        rays = views(1)[0].rays(reference.near, reference.far)
        shape = rays.directions.shape[:-1]
        colours = images[scene].movedim(1, -1)
        for step in range(STEPS):
            view, row, column = torch.unravel_index(picked[step], shape)
            chosen = Rays(
                rays.origins.expand(*shape, 3)[view, row, column][None],
                rays.directions[view, row, column][None],
                rays.near.expand(shape)[view, row, column][None],
                rays.far.expand(shape)[view, row, column][None],
            )
            seen = None if coarse is None else coarse[scene, view, row, column][None]
            rgb = RENDERER.render(reference.field(), chosen, jitter[step][None], seen).rgb[0]
            loss = F.mse_loss(rgb, colours[view, row, column])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            assert losses[step, scene].item() == pytest.approx(loss.item(), rel=1e-4)
        torch.testing.assert_close(field.planes[scene], reference.planes[0], atol=2e-5, rtol=1e-4)
        for name, value in reference.decoder.named_parameters():
            fitted = dict(field.decoder.named_parameters())[name][scene]
            torch.testing.assert_close(fitted, value, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("side", [1, 3, SIZE])
def test_patches_are_the_cameras_rays_at_squares_of_pixels_of_the_chosen_views(side):
    field, cameras = fields(2), views(2)
    images = torch.rand(2, 2, 3, SIZE, SIZE)
    batches = RayBatches(cameras, field.near, field.far)
    batches.set_colours(images)
    batches.set_weights(images[:, :, 0])
    every = cameras.rays(field.near[:, None], field.far[:, None])
    for chosen in (None, torch.tensor([[1], [0]])):
        batches.set_views(chosen)
        picked = batches.draw(
            side, torch.empty(2, 9, dtype=torch.long), [torch.Generator().manual_seed(5 + s) for s in (0, 1)]
        )
        rays, colours = batches.at(picked)
        weights = batches.weights_at(picked)
        assert picked.shape == (2, 9 * side**2)
        seen = set()
        for scene in range(2):
            for patch in range(9):
                first = int(picked[scene, patch * side**2])
                view, row, column = first // SIZE**2, first // SIZE % SIZE, first % SIZE
                seen.add((scene, view))
                assert row + side <= SIZE and column + side <= SIZE
                square = (scene, view, slice(row, row + side), slice(column, column + side))
                own = slice(patch * side**2, (patch + 1) * side**2)
                for name in ("origins", "directions"):
                    expected = getattr(every, name)[square].reshape(-1, 3)
                    torch.testing.assert_close(getattr(rays, name)[scene, own], expected, atol=0, rtol=0)
                assert rays.near[scene, own].eq(every.near[square].flatten()).all()
                assert colours[scene, own].eq(images.movedim(2, -1)[square].reshape(-1, 3)).all()
                assert weights[scene, own].eq(images[:, :, 0][square].flatten()).all()
        assert seen == {(0, 1), (1, 0)} if chosen is not None else len(seen) == 4


def test_patches_are_everywhere_that_they_fit():
    batches = RayBatches(views(1), torch.tensor([0.8]), torch.tensor([1.8]))
    side = SIZE - 1
    picked = batches.draw(side, torch.empty(1, 200, dtype=torch.long), [torch.Generator().manual_seed(0)])
    corners = set(picked[0, :: side**2].tolist())
    assert corners == {view * SIZE**2 + row * SIZE + column for view in (0, 1) for row in (0, 1) for column in (0, 1)}


@pytest.mark.parametrize(("side", "rays", "message"), [(SIZE + 1, 289, "images of 16 pixels"), (3, 32, "27 or 36")])
def test_patches_that_cannot_be_are_refused(side, rays, message):
    with pytest.raises(ConfigError, match=message):
        inner_steps(fields(1), IMAGES, rays, objective=Objective(patch=side))


def test_steps_on_patches_with_weights_and_regularisers_are_those_of_a_plain_loop():
    """Written out in one place; each scene's own, with all that an objective has."""
    side, objective = 8, Objective(patch=8, loss="l1", perceptual_weight=0.2, entropy_weight=0.1)
    field, images = fields(2), torch.rand(2, 2, 3, SIZE, SIZE)
    weights = torch.rand(2, 2, SIZE, SIZE)
    references = [copy.deepcopy(field.alone(scene)) for scene in range(2)]
    average = WeightAverage(field)
    average.start()
    inner = inner_steps(field, images, 2 * side**2, objective=objective, average=average)
    inner.batches.set_weights(weights)
    errors, patchwise = inner.run(3), FitLoss(objective)
    assert inner.queries == 128 * 7 + 16 * 4
    for scene, reference in enumerate(references):
        draws = torch.Generator().manual_seed(scene)
        corners = torch.empty(3, 2, dtype=torch.long).random_(2 * (SIZE - side + 1) ** 2, generator=draws)
        jitter = torch.empty(3, 128, 7).uniform_(generator=draws)
        optimizer = torch.optim.Adam(
            [{"params": [reference.planes], "lr": 1e-2}, {"params": reference.decoder.parameters(), "lr": 1e-3}],
            foreach=False,
        )
        rays = views(1)[0].rays(reference.near, reference.far)
        parts = {
            name: values.expand(*rays.directions.shape[:3], *values.shape[3:]) for name, values in vars(rays).items()
        }
        planes = []
        for step in range(3):
            view, row, column = torch.unravel_index(corners[step], (2, SIZE - side + 1, SIZE - side + 1))
            squares = [
                (int(v), slice(int(r), int(r) + side), slice(int(c), int(c) + side))
                for v, r, c in zip(view, row, column, strict=True)
            ]

            def taken(values, squares=squares):
                return torch.cat([values[square].flatten(0, 1) for square in squares])[None]

            chosen = Rays(**{name: taken(values) for name, values in parts.items()})
            colours, weighed = taken(images[scene].movedim(1, -1)), taken(weights[scene])
            rgb = RENDERER.render(reference.field(), chosen, jitter[step][None]).rgb
            loss, _ = patchwise(rgb, colours, weighed)
            few = Rays(**{name: values[:, ::8] for name, values in vars(chosen).items()})
            loss = loss + 0.1 * ray_entropy(reference.field(), few, jitter[step][None, ::8, :4]).mean()
            assert errors[step, scene].item() == pytest.approx((rgb - colours).square().mean().item(), rel=1e-4)
            optimizer.zero_grad()
            loss.sum().backward()
            optimizer.step()
            planes.append(reference.planes.detach()[0].clone())
        torch.testing.assert_close(field.planes[scene], planes[-1], atol=2e-5, rtol=1e-4)
        mean = torch.stack(planes).mean(0)
        torch.testing.assert_close(average.snapshot()["planes"][scene], mean, atol=2e-5, rtol=1e-4)


def test_the_mean_is_of_the_steps_since_it_began():
    field, found = fields(1), []
    average = WeightAverage(field)
    inner = inner_steps(field, IMAGES, average=average)
    inner.run(2)
    average.start()
    for _ in range(3):
        inner.run(1)
        found.append(field.snapshot())
    for name, value in average.snapshot().items():
        torch.testing.assert_close(value, torch.stack([one[name] for one in found]).mean(0))


def test_painting_changes_what_is_fitted_and_drawing_goes_on():
    field, images = fields(1), torch.rand(1, 2, 3, SIZE, SIZE)
    inner = inner_steps(field, images)
    inner.run(2)
    first = inner._picked.clone()
    inner.batches.set_colours(torch.zeros_like(images))
    inner.run(2)
    assert not torch.equal(inner._picked, first)
    assert inner.batches.at(inner._picked[:, 0])[1].eq(0).all()


def test_what_is_remembered_anew_stays_in_its_place():
    """A recorded step reads memory, not names."""
    inner = inner_steps(fields(1), torch.rand(1, 2, 3, SIZE, SIZE), coarse=torch.zeros(1, 2, SIZE, SIZE, 4))
    before = inner.batches._coarse.data_ptr()
    inner.batches.set_coarse(torch.ones(1, 2, SIZE, SIZE, 4))
    assert inner.batches._coarse.data_ptr() == before
    assert inner.batches.coarse_at(torch.tensor([[3, 500]])).eq(1).all()


def test_no_step_is_no_loss_and_no_change():
    field = fields(1)
    before = field.planes.detach().clone()
    assert inner_steps(field, torch.rand(1, 2, 3, SIZE, SIZE)).run(0).shape == (0, 1)
    assert torch.equal(field.planes, before)


def test_one_ray_is_enough():
    losses = inner_steps(fields(1), torch.rand(1, 2, 3, SIZE, SIZE), rays=1).run(2)
    assert losses.shape == (2, 1) and bool(torch.isfinite(losses).all())


def recording(monkeypatch, error: Exception | None = None, at_end: Exception | None = None):
    """Inner steps on a CPU that take it for a GPU, and how their steps were recorded.

    Args:
        error: raised when the step to record starts.
        at_end: raised because of it when recording ends.
    """
    inner, asked = inner_steps(fields(1), IMAGES), []
    step = inner._step

    class Graph:
        replay = staticmethod(step)

    def recorded_only():
        if error is not None:
            raise error

    @contextmanager
    def graph(_, **options):
        asked.append(options)
        monkeypatch.setattr(inner, "_step", recorded_only)
        try:
            yield
        finally:
            monkeypatch.setattr(inner, "_step", step)
            if at_end is not None:
                raise at_end

    streams = type("Stream", (), {"wait_stream": lambda *_: None})
    for name, value in {"CUDAGraph": Graph, "Stream": streams, "current_stream": streams}.items():
        monkeypatch.setattr(torch.cuda, name, value)
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(InnerSteps, "recording", True)
    monkeypatch.setattr(inner, "_record", True)
    return inner, asked


def test_other_threads_may_allocate_while_a_step_is_recorded(monkeypatch):
    inner, asked = recording(monkeypatch)
    losses = inner.run(6)
    assert asked == [{"capture_error_mode": "thread_local"}] and inner.recorded
    torch.testing.assert_close(losses, inner_steps(fields(1), IMAGES).run(6))


MEMORY, OTHER = torch.OutOfMemoryError("CUDA out of memory"), RuntimeError("operation not permitted")


@pytest.mark.parametrize(
    ("error", "at_end", "others_record"),
    [(MEMORY, None, True), (MEMORY, RuntimeError("capture was invalidated"), True), (OTHER, None, False)],
)
def test_steps_that_cannot_be_recorded_are_taken(error, at_end, others_record, monkeypatch, caplog):
    inner, asked = recording(monkeypatch, error, at_end)
    for _ in range(2):
        assert bool(torch.isfinite(inner.run(6)).all())
    assert len(asked) == len(caplog.records) == 1 and not inner.recorded
    assert str(at_end or error) in caplog.messages[0]
    assert InnerSteps.recording is others_record


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
@pytest.mark.parametrize("remembered", [False, True])
def test_a_recorded_step_does_what_the_step_does(remembered):
    images = torch.rand(2, 2, 3, SIZE, SIZE, device="cuda")
    field, recorded = fields(2, "cuda"), fields(2, "cuda")
    plain, replayed = inner_steps(field, images), inner_steps(recorded, images, record=True)
    for _ in range(2):  # the second time, everything is replayed
        if remembered:
            coarse = torch.rand(2, 2, SIZE, SIZE, RENDERER.uniform_samples, device="cuda").pow(4)
            plain.batches.set_coarse(coarse)
            replayed.batches.set_coarse(coarse)
        torch.testing.assert_close(replayed.run(8), plain.run(8), atol=1e-5, rtol=1e-3)
        replayed.optimizer.param_groups[0]["lr"].mul_(0.5)
        plain.optimizer.param_groups[0]["lr"].mul_(0.5)
    assert replayed._graph is not None
    torch.testing.assert_close(recorded.planes, field.planes, atol=1e-4, rtol=1e-3)


def test_a_field_grows_where_it_is_empty_although_faint_samples_are_skipped():
    losses = {}
    for skip in ("none", "faint"):
        field = fields(1)
        with torch.no_grad():
            field.planes *= 0.05
            field.decoder.output.bias[3] = -9.0  # so empty that nothing is seen
        steps = inner_steps(field, torch.zeros(1, 2, 3, SIZE, SIZE))  # and everything should be black
        steps.renderer = Renderer(4, 3, 1.0, 4096, skip=skip)
        for group in steps.optimizer.param_groups:
            group["lr"].fill_(0.2)
        losses[skip] = steps.run(30)[:, 0]
    assert losses["none"][0] > 0.99 and losses["none"][-5:].mean() < 0.2
    assert losses["faint"][-5:].mean() < 1.05 * losses["none"][-5:].mean() + 1e-3
