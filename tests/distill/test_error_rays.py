"""Rays that are drawn where the error is."""

import pytest
import torch
from test_ngd_module import TEACHERS, distillation, guided, scene
from test_virtual_views import net

from model_fixtures import input_cameras
from nerfdiff.cameras import Cameras
from nerfdiff.distill.module import NGDModule
from nerfdiff.fit.objective import Objective
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.utils.errors import ConfigError


def batches(scenes: int = 2, views: int = 3) -> RayBatches:
    cameras = input_cameras(scenes)
    cameras = Cameras.stack([cameras] * views, dim=1)
    made = RayBatches(cameras, torch.full((scenes,), 0.8), torch.full((scenes,), 1.8))
    made.set_colours(torch.rand(scenes, views, 3, 16, 16, generator=torch.Generator().manual_seed(0)))
    return made


def draw(made: RayBatches, count: int):
    sources = [torch.Generator().manual_seed(scene) for scene in range(made.shape[0])]
    return made.draw(1, torch.empty(made.shape[0], count, dtype=torch.long), sources)


def test_rays_are_drawn_in_proportion_to_their_shares():
    made, shares = batches(), torch.zeros(2, 3, 16, 16)
    shares[0, 1, 2, 3], shares[0, 2, 15, 15] = 3.0, 1.0
    shares[1, 0, 0, 0] = 1.0
    made.set_shares(shares)
    picked = draw(made, 4000)
    assert picked[1].eq(0).all()
    numbers, counts = picked[0].unique(return_counts=True)
    assert numbers.tolist() == [256 + 2 * 16 + 3, 3 * 256 - 1]
    assert counts[0] / 4000 == pytest.approx(0.75, abs=0.03)


def test_weights_make_up_for_how_often_rays_are_drawn():
    made = batches(1)
    shares = 0.5 + 0.5 * torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(1)).mul(6).exp()
    shares = shares / shares.mean()
    made.set_shares(shares)
    made.set_weights(1 / shares)
    picked = draw(made, 200_000)
    _, colours = made.at(picked)
    weighed = (made.weights_at(picked)[..., None] * colours).mean((0, 1))
    every = made.at(torch.arange(3 * 256)[None])[1].mean((0, 1))
    torch.testing.assert_close(weighed, every, atol=0.01, rtol=0)
    assert (colours.mean((0, 1)) - every).abs().max() > 0.01  # unweighed it is another mean


@pytest.fixture
def seen(monkeypatch):
    """The shares and weights that a distillation sets, step by step."""
    found = []
    for name in ("set_shares", "set_weights"):
        plain = getattr(RayBatches, name)

        def noted(self, values, name=name, plain=plain):
            found.append((name, values.clone()))
            return plain(self, values)

        monkeypatch.setattr(RayBatches, name, noted)
    return found


@pytest.mark.parametrize("options", [{}, {"fit_source": True}, {"views_last": 1, "fit_source": True}])
def test_shares_follow_the_error_and_weights_undo_them(options, seen):
    module = distillation(guided(condition="current"), error_rays=0.5, **options).distil(net(), [scene()], seed=0)
    assert module.statuses == ["ok"] and len(seen) == 2 * 4
    source = int(options.get("fit_source", False))
    for number in range(4):
        (_, weights), (_, shares) = seen[2 * number : 2 * number + 2]
        chosen = shares.flatten(2).sum(2)[0] > 0
        assert chosen.sum() == (3 if "views_last" not in options else (3, 2, 2, 1)[number]) + source
        assert shares[:, chosen].mean() == pytest.approx(1, abs=1e-4) and shares[:, chosen].min() >= 0.5
        torch.testing.assert_close((weights * shares)[:, chosen], torch.ones_like(shares[:, chosen]))
        if source:
            assert shares[0, -1].eq(1).all()
    assert seen[-1][1].std() > 0.05


def test_views_that_a_teacher_weighs_keep_their_weights(seen):
    from nerfdiff.distill.sds import SDSTeacher

    teacher = lambda views: SDSTeacher(views, 2, 0.98, 0.02, "current", "sigma2")  # noqa: E731
    distillation(teacher, error_rays=0.5).distil(net(), [scene()], seed=0)
    (_, weights), (_, shares) = seen[:2]
    of_views = (weights * shares)[0].flatten(1)
    torch.testing.assert_close(of_views, of_views[:, :1].expand_as(of_views))
    assert of_views[:, 0].std() > 0


def test_where_nothing_is_rendered_on_the_way_rays_are_drawn_alike(seen):
    fields = [distillation(TEACHERS["direct"], error_rays=by).distil(net(), [scene()], seed=0).field for by in (0, 0.5)]
    assert torch.equal(fields[0].planes, fields[1].planes) and not seen


def test_scenes_are_drawn_by_their_own_errors():
    method = distillation(guided(condition="current"), error_rays=0.5, lr_planes=1e-3)
    together = method.distil(net(), [scene("a"), scene("b")], seed=0)
    alone = method.distil(net(), [scene("b")], seed=0)
    torch.testing.assert_close(together.field.alone(1).planes, alone.field.planes, atol=1e-4, rtol=1e-4)


def test_a_share_of_the_rays_is_that_many():
    full, half = (distillation(guided(), rays_share=share).distil(net(), [scene()], seed=0) for share in (1, 0.5))
    queries = [module.views[0].field_queries for module in (full, half)]
    assert queries[0] - queries[1] == 4 * 3 * 32 * net().renderer.samples_per_ray


def test_a_share_of_the_steps_runs_to_the_same_end(monkeypatch):
    places, plain = [], NGDModule.training_step

    def noted(self, *args):
        places.append((self.course.position, self.course.until))
        return plain(self, *args)

    monkeypatch.setattr(NGDModule, "training_step", noted)
    module = distillation(guided(), steps_share=0.5).distil(net(), [scene()], seed=0)
    assert places == [(0, 2), (2, 4)] and module.course.stopped_by == "schedule"
    (views,) = distillation(guided(), steps_share=0.5).predict(net(), [scene()], seed=0)
    assert (views.steps, views.steps_planned) == (2, 2)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"error_rays": 1.0}, "error_rays=1.0"),
        ({"rays_share": 0.0}, "rays_share=0.0"),
        ({"steps_share": 1.5}, "steps_share=1.5"),
        ({"error_rays": 0.5, "objective": Objective(8)}, "strategy.patch=1"),
    ],
)
def test_impossible_shares_are_refused(options, said):
    with pytest.raises(ConfigError, match=said):
        distillation(guided(), **options).distil(net(), [scene()], seed=0)
