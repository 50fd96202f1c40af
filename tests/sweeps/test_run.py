"""Sweeps whose jobs are a function, on launchers that fail in every way that they can."""

from collections import Counter

import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from omegaconf import OmegaConf

from nerfdiff.evaluation import measure
from nerfdiff.results.row import ResultRow, append_row, read_rows
from nerfdiff.sweeps import task as task_module
from nerfdiff.sweeps.jobs import jobs_of
from nerfdiff.sweeps.plan import read_plan
from nerfdiff.sweeps.proposals import Grid, Random
from nerfdiff.sweeps.run import DEATHS, Run
from nerfdiff.sweeps.space import Axis, Space
from nerfdiff.sweeps.task import Task
from nerfdiff.utils.errors import DataError

N = 6
SPACE = Space(((Axis("x", tuple(f"x={i}" for i in range(N))), Axis("ckpt", ("ckpt=demo",))),), (), ("seed=0", "seed=1"))


class Here(Launcher):
    """Runs jobs in this process; `job` gets the overrides and returns the row's status, None for a row that is lost."""

    def __init__(self, folder, job=lambda words: "ok"):
        self.folder, self.job, self.batches, self.task = folder, job, [], None

    def setup(self, **settings):
        pass

    def launch(self, job_overrides, initial_job_idx):
        self.batches.append([" ".join(words[:1] + words[2:3]) for words in job_overrides])
        return [self._run(words) for words in job_overrides]

    def _run(self, words):
        assert words[-1].startswith("hydra.sweep.subdir=")
        return self.task(OmegaConf.create({"words": words[:-1]})) or JobReturn(status=JobStatus.COMPLETED)

    def function(self, cfg):
        words = list(cfg.words)
        status = self.job(words)
        if status is not None:
            row = ResultRow(run_id="x", overrides=words, seed=int(words[-1][5:]), status=status, psnr=1.0)
            append_row(self.folder / "results.jsonl", row)

    @property
    def ran(self):
        return [job for batch in self.batches for job in batch]


def sweep(launcher, proposals=None, batch_size=4, retry=True, until=None, space=SPACE):
    launcher.task = Task(launcher.function, until)
    hydra = {"sweep": {"dir": str(launcher.folder)}, "sweeper": {"proposals": {}}}
    return Run(
        config=OmegaConf.create({"hydra": hydra}),
        space=space,
        proposals=proposals or Grid(),
        launcher=launcher,
        load=lambda config, words: config,
        task=launcher.task,
        batch_size=batch_size,
        retry=retry,
    )


def jobs(numbers):
    return [f"x={x} seed={seed}" for x in numbers for seed in (0, 1)]


def test_every_configuration_is_run_once_with_all_seeds(tmp_path):
    launcher = Here(tmp_path)
    sweep(launcher)()
    assert launcher.batches == [jobs(range(4)), jobs(range(4, N))]
    again = Here(tmp_path)
    sweep(again)()
    assert again.batches == []
    assert len(read_plan(tmp_path)) == len(read_rows(tmp_path / "results.jsonl")) == 2 * N


def test_of_jobs_that_differ_in_numbers_one_is_composed_before_they_begin(tmp_path):
    words = ("strategy=ngd", "strategy=none", *(f"x={n}/40" for n in range(1, 41)))
    axes = Axis("strategy", words[:2]), Axis("x", words[2:])
    composed = []
    run = sweep(Here(tmp_path), batch_size=None, space=Space((axes,), (), ("seed=0",)))
    run.load = lambda config, words: composed.append(words) or config
    run()
    assert sorted(words[0] for words in composed) == ["strategy=ngd", "strategy=none"]
    assert len(read_rows(tmp_path / "results.jsonl")) == 80


def test_a_sweep_that_was_killed_goes_on_with_what_is_left(tmp_path):
    def dies(words):
        if words[0] == "x=2":
            raise KeyboardInterrupt
        return "ok"

    with pytest.raises(KeyboardInterrupt):
        sweep(Here(tmp_path, dies))()
    launcher = Here(tmp_path)
    sweep(launcher)()
    assert launcher.ran == jobs(range(2, N))
    assert set(Counter(tuple(row.overrides) for row in read_rows(tmp_path / "results.jsonl")).values()) == {1}


@pytest.mark.parametrize("retry", [True, False])
def test_failures_do_not_end_a_sweep_and_are_tried_again_if_wanted(tmp_path, retry):
    launcher = Here(tmp_path, lambda words: "oom" if words[0] == "x=1" else "ok")
    sweep(launcher)()
    assert launcher.ran == jobs(range(N))
    again = Here(tmp_path)
    sweep(again, retry=retry)()
    assert again.ran == (jobs([1]) if retry else [])


def test_a_failure_that_nothing_took_note_of_is_told_at_the_end(tmp_path):
    launcher = Here(tmp_path)
    launcher._run = lambda words: JobReturn(status=JobStatus.FAILED, _return_value=OSError(f"no {words[0]}"))
    with pytest.raises(CompactHydraException, match=r"12 jobs failed: .*no x=0"):
        sweep(launcher)()
    assert launcher.ran == jobs(range(N))


@pytest.mark.parametrize("deadly", [["x=1 seed=0"], jobs([0, 1])])
def test_jobs_that_take_their_process_along_are_rows_and_the_others_of_their_batch_run(deadly, tmp_path, monkeypatch):
    dying = []

    def dies(words):
        if f"{words[0]} {words[-1]}" in deadly:
            dying[:] = words
            raise ChildProcessError("killed")
        return "ok"

    def record(config, error, subject, strategy):
        words = list(dying)
        append_row(tmp_path / "results.jsonl", ResultRow(run_id="x", overrides=words, status="error", error=str(error)))

    monkeypatch.setattr(measure, "record_failure", record)
    monkeypatch.setattr("nerfdiff.sweeps.run.HydraConfig", pytest.MonkeyPatch)  # there is no Hydra here
    monkeypatch.setattr(pytest.MonkeyPatch, "instance", lambda: Instance(), raising=False)
    launcher = Here(tmp_path, dies)
    run = sweep(launcher)
    run.load = lambda config, words: OmegaConf.create(
        {"strategy": {}, "hydra": {"runtime": {}, "sweep": {"subdir": words[-1]}}}
    )
    run()
    rows = read_rows(tmp_path / "results.jsonl")
    assert Counter(row.status for row in rows) == {"ok": 2 * N - len(deadly), "error": len(deadly)}
    lost = {f"{row.overrides[0]} {row.overrides[-1]}": row.error for row in rows if row.status == "error"}
    assert lost == dict.fromkeys(deadly, "killed")


class Instance:
    def set_config(self, config):
        pass


def test_a_launcher_that_never_works_ends_the_sweep(tmp_path, monkeypatch):
    launcher, recorded = Here(tmp_path), []

    def broken(job_overrides, initial_job_idx):
        raise ModuleNotFoundError("no scheduler")

    launcher.launch = broken
    run = sweep(launcher)
    monkeypatch.setattr(Run, "_record", lambda self, job, error: recorded.append(job))
    with pytest.raises(ModuleNotFoundError, match="no scheduler"):
        run()
    assert len(recorded) == DEATHS


def test_no_job_begins_when_the_minutes_are_spent(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(task_module.time, "time", lambda: clock[0])

    def takes_ten_seconds(words):
        clock[0] += 10.0
        return "ok"

    launcher = Here(tmp_path, takes_ten_seconds)
    run = sweep(launcher, batch_size=2, until=55.0)
    run()
    rows = read_rows(tmp_path / "results.jsonl")
    assert len(rows) == 6 and len(launcher.batches) == 2  # the sixth began at 50
    assert [job.status for job in jobs_of(run.config)] == ["ok"] * 6 + ["not run"] * 6
    launcher = Here(tmp_path, takes_ten_seconds)
    sweep(launcher, until=clock[0] + 600)()
    assert launcher.ran == jobs(range(3, N))


def test_random_configurations_are_distinct_and_a_longer_sweep_begins_like_a_shorter_one(tmp_path):
    some, more = (Random(n, 7).known(SPACE, {}) for n in (3, 5))
    assert some == more[:3] and len(set(more)) == 5 and set(more) < set(SPACE)
    assert sorted(Random(100, 1).known(SPACE, {})) == sorted(SPACE)
    assert Random(5, 8).known(SPACE, {}) != more
    launcher = Here(tmp_path)
    sweep(launcher, Random(3, 7))()
    sweep(launcher, Random(5, 7))()
    assert launcher.batches == [jobs(int(c[0][2:]) for c in some), jobs(int(c[0][2:]) for c in more[3:])]


def test_a_damaged_plan_is_named(tmp_path):
    (tmp_path / "plan.json").write_text('{"jobs": 3}')
    with pytest.raises(DataError, match=r"plan\.json"):
        read_plan(tmp_path)
