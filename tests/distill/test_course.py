"""Distillations that end early: by a deadline, on a clock of our own, or as field and CDM agree no better."""

import pytest
import torch
from test_ngd_module import distillation, guided, prior, sampling, scene
from test_virtual_views import net

from nerfdiff.distill.course import AGREEMENT, DEADLINE, SCHEDULE, Course, Plateau
from nerfdiff.distill.direct import DirectTeacher
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.ngd import Guidance, NGDTeacher
from nerfdiff.distill.sds import SDSTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.utils.errors import ConfigError

STEPS, INNER = 12, 6
TEACHERS = {
    "ngd": lambda views: NGDTeacher(views, STEPS, sampling(), Guidance("linear", 1.0, "last"), "current"),
    "direct": lambda views: DirectTeacher(views, STEPS, 3, sampling()),
    "sds": lambda views: SDSTeacher(views, STEPS, 0.98, 0.02, "current"),
}


class Work:
    """A clock on which each view that is rendered or denoised takes a second, and each inner step one too."""

    def __init__(self):
        self.now, self.slower, self.steps = 0.0, 1.0, 0
        self.slow_from = None

    def __call__(self) -> float:
        return self.now

    def spend(self, seconds: float) -> None:
        self.now += seconds * self.slower


@pytest.fixture
def work(monkeypatch):
    clock = Work()

    def takes(owner, name, seconds):
        plain = getattr(owner, name)

        def slow(self, *args, **kwargs):
            clock.spend(seconds(self, *args, **kwargs))
            return plain(self, *args, **kwargs)

        monkeypatch.setattr(owner, name, slow)

    takes(VirtualViews, "__init__", lambda self, model, encoding, cameras, *rest: cameras.shape[1])
    takes(VirtualViews, "denoise", lambda self, *args, **more: len(self) if self.chosen is None else len(self.chosen))
    takes(NGDModule, "_render", lambda self, cameras, *rest, **more: cameras.shape[1])
    takes(InnerSteps, "run", lambda self, steps: steps)
    return clock


def run(work, seconds, teacher="ngd", of=None, method=None, **options):
    """Distil by a deadline; return the module, the method and the seconds that it took."""
    options = {"inner_steps": INNER, "rays": 16, "lr_planes": 1e-3} | options
    method = method or distillation(TEACHERS[teacher], seconds=seconds, clock=work, **options)
    start = work.now
    module = method.distil(of or net(), [scene()], seed=0)
    return module, method, work.now - start


FULL = 3 + STEPS * (3 + 3 + INNER) + 2 * (3 + 1)


@pytest.mark.parametrize("teacher", ["ngd", "direct"])
def test_with_enough_time_nothing_changes(teacher, work):
    without, _, _ = run(work, None, teacher)
    module, method, _ = run(work, 10 * FULL, teacher)
    again, _, took = run(work, None, method=method)  # a scene later, whose pace is known
    assert all(torch.equal(m.field.planes, without.field.planes) for m in (module, again))
    assert again.course.taken == STEPS and again.course.stopped_by == SCHEDULE and took <= FULL


@pytest.mark.parametrize(("teacher", "share"), [("ngd", 0.8), ("ngd", 0.25), ("ngd", 0.12), ("sds", 0.5)])
def test_the_schedule_ends_within_the_deadline(teacher, share, work):
    seconds = share * FULL + 12  # the first scene is rehearsed
    module, method, took = run(work, seconds, teacher)
    later, _, second = run(work, None, method=method)
    for one, spent in ((module, took), (later, second)):
        assert one.course.stopped_by == DEADLINE and one.course.position == STEPS
        assert one.course.taken < STEPS or len(one.views[0]) < 3 or one.settings.inner_steps < INNER
        assert spent <= 1.1 * seconds
    assert second >= 0.7 * min(seconds, FULL)  # and does not waste it
    assert later.statuses == ["ok"] and len(later.trace(0)) == later.course.taken


def test_views_that_are_sampled_beforehand_leave_time_for_the_fit(work):
    module, _, took = run(work, 60.0, "direct")
    assert module.course.stopped_by == DEADLINE and module.course.position == STEPS and took <= 66


def test_a_machine_that_slows_down_takes_longer_steps(work, monkeypatch):
    _, method, _ = run(work, 100.0)
    plain = NGDModule.training_step

    def step(self, *args):
        work.slower = 1.0 if self.course.taken < 2 else 2.5
        return plain(self, *args)

    monkeypatch.setattr(NGDModule, "training_step", step)
    module, _, took = run(work, None, method=method)
    work.slower = 1.0
    assert (
        module.course.position == STEPS and took <= 1.1 * 100 + 2.5 * 8
    )  # the check at the end was planned at the old pace
    lengths = module.course.taken
    assert 2 < lengths < STEPS


def test_diffusion_times_run_to_their_end_in_longer_steps():
    """Half the steps are the steps of a schedule of half the length."""

    def images(steps, affordable):
        views = VirtualViews(net(), net().encode(scene()), prior(3)(scene()), 2, (0,))
        teacher = NGDTeacher(views, steps, sampling(), Guidance("linear", 1.0, "last"), "first")
        course, rendered = Course(steps), torch.full((3, 3, 16, 16), 0.5)
        times = []
        while course.begin_step(affordable and affordable - course.taken):
            views.until = course.until
            found = teacher.targets(course.position, rendered)
            times.append(teacher.t)
            course.end_step()
        return times, found

    short, few = images(4, None), images(8, 4)
    assert short[0] == pytest.approx(few[0]) and len(few[0]) == 4
    torch.testing.assert_close(short[1], few[1], atol=1e-5, rtol=1e-5)


def test_without_any_time_the_field_is_the_single_image_nerf(work):
    of = net()
    module, method, _ = run(work, 1e-3, of=of)
    assert module.course.taken == 0 and module.course.stopped_by == DEADLINE and module.statuses == ["ok"]
    with torch.no_grad():
        assert torch.equal(module.field.planes, of.encode(scene()).triplane.planes)
    (predicted,) = method.predict(of, [scene()], 0)
    assert (predicted.steps, predicted.steps_planned, predicted.stopped_by) == (0, STEPS, DEADLINE)
    assert predicted.images.isfinite().all()


def test_a_mean_over_the_last_steps_is_not_of_the_first_field(work):
    _, method, _ = run(work, 60.0, average=0.25)
    later, _, _ = run(work, None, method=method)
    with torch.no_grad():
        start = net().encode(scene()).triplane.planes
    assert later.course.taken < STEPS * 0.75
    assert not torch.equal(later.field.planes, start)


def test_scenes_together_have_their_time_together(work):
    method = distillation(TEACHERS["ngd"], inner_steps=INNER, rays=16, seconds=100.0, clock=work)
    method.distil(net(), [scene()], seed=0)
    start = work.now
    method.distil(net(), [scene("a"), scene("b")], seed=0)
    assert 1.1 * 100 < work.now - start <= 1.1 * 200


def test_only_the_first_scene_is_rehearsed(work):
    _, method, first = run(work, 10 * FULL)
    _, _, second = run(work, None, method=method)
    assert second <= FULL < first


def test_a_deadline_without_time_is_refused():
    with pytest.raises(ConfigError, match="seconds_per_scene=0"):
        distillation(guided(), seconds=0)


def test_strides_are_even_and_end_at_the_end():
    course, places = Course(10), []
    while course.begin_step(4 - course.taken):
        places.append((course.position, course.until))
        course.end_step()
    assert places == [(0, 2.5), (2.5, 5), (5, 7.5), (7.5, 10)] and course.stopped_by == DEADLINE
    course, places = Course(3), []
    while course.begin_step(7):
        places.append((course.position, course.until))
        course.end_step()
    assert places == [(0, 1), (1, 2), (2, 3)] and course.stopped_by == SCHEDULE
    assert not Course(3).begin_step(0)


@pytest.mark.parametrize(
    ("patience", "rise", "enough"),
    [(1, 0.0, 3), (2, 0.0, 4), (1, 0.5, 1), (3, 0.0, None), (1, -9.0, None)],
)
def test_a_plateau_is_where_the_best_of_before_is_not_exceeded(patience, rise, enough):
    plateau, values = Plateau(patience, rise), [30.0, 30.4, 31.0, 30.9, 30.8, 31.2]
    assert next((number for number, value in enumerate(values) if plateau(value)), None) == enough


def agreeing(gaps, **options):
    """Distil with the agreement (dB) of each step given."""

    class Told(NGDTeacher):
        def targets(self, step, rendered):
            made = super().targets(step, rendered)
            self.gap = None if (told := next(gaps)) is None else torch.tensor(10.0 ** (-told / 10))
            return made

    def teacher(views):
        return Told(views, STEPS, sampling(), Guidance("linear", 1.0, "last"), "current")

    return distillation(teacher, inner_steps=1, rays=16, lr_planes=1e-3, **options).distil(net(), [scene()], 0)


def test_what_is_left_is_one_step_where_agreement_rises_no_longer():
    module = agreeing(iter([30.0, 31.0, 31.0, 31.1, 33.0, 9.0]), patience=2, rise=0.2)
    assert module.course.taken == 5 and module.course.position == STEPS and module.course.stopped_by == AGREEMENT
    assert module.course.planned == STEPS
    assert module.views[0].denoiser_calls == 5 * 3 and module.statuses == ["ok"]
    assert module.trace(0)[-1].t == pytest.approx(float(sampling().times(STEPS)[4]))
    still = agreeing(iter([30.0 + number for number in range(STEPS)]), patience=2, rise=0.2)
    assert still.course.taken == STEPS and still.course.stopped_by == SCHEDULE
    late = agreeing(iter([*map(float, range(10)), 8.0, 8.0]), patience=1, rise=0.0)  # one step is left in any case
    assert late.course.taken == STEPS and late.course.stopped_by == SCHEDULE
    unknown = agreeing(iter([None] * STEPS), patience=1, rise=0.0)
    assert unknown.course.taken == STEPS


def test_agreement_is_of_renderings_and_denoised_images():
    views = VirtualViews(net(), net().encode(scene()), prior(3)(scene()), 2, (0,))
    teacher = NGDTeacher(views, 4, sampling(), Guidance("constant", 0.5, "current"), "first")
    rendered = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    targets = teacher.targets(0, rendered)
    # guided images are halfway between both
    assert float(teacher.gap) == pytest.approx(4 * float((targets - rendered).square().mean()), rel=1e-3)
    views.chosen = torch.tensor([1])
    targets = teacher.targets(1, rendered)
    assert float(teacher.gap) == pytest.approx(4 * float((targets - rendered)[1].square().mean()), rel=1e-3)
    full = NGDTeacher(views, 4, sampling(), Guidance("constant", 1.0, "current"), "first")
    full.targets(0, rendered)
    assert full.gap is None
    overshooting = NGDTeacher(views, 4, sampling(), Guidance("constant", 0.5, "last"), "first")
    overshooting.targets(0, rendered)
    assert overshooting.gap is None


def test_scenes_together_cannot_end_by_themselves():
    method = distillation(guided(), patience=2)
    with pytest.raises(ConfigError, match="scenes_at_once=1"):
        method.distil(net(), [scene("a"), scene("b")], seed=0)
    with pytest.raises(ConfigError, match="patience=0"):
        distillation(guided(), patience=0)
