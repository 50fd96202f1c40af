import re
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig

from nerfdiff.cli import entry_point, job_folder, prepare_arguments
from nerfdiff.inputs import checkpoints, find_weights
from nerfdiff.quoting import parse_override


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Runs a sweep of jobs that do nothing; the names of their folders by the jobs' overrides."""

    monkeypatch.setattr("nerfdiff.cli.quieten", lambda: None)  # the loggers are those of all tests

    def sweep(command: str, *words: str) -> dict[str, str]:
        found = {}

        def job(cfg):
            hydra = HydraConfig.get()
            assert Path(hydra.runtime.output_dir).parent == tmp_path / "sweep"
            found[" ".join(hydra.overrides.task)] = hydra.sweep.subdir

        quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none", f"hydra.sweep.dir={tmp_path / 'sweep'}")
        monkeypatch.setattr("sys.argv", [f"{command}.py", *words, *quiet])
        entry_point(command)(job)()
        assert all((tmp_path / "sweep" / name).is_dir() for name in found.values())
        return found

    return sweep


def test_folders_are_named_by_what_is_swept(folders):
    # the same command goes on in the same folders; other data have others
    fixed = ["data=posed_images", f"run_name={'x' * 300}", "data.image_size=[32,32]", "optimizer.lr=1e-3,2e-3"]
    here = folders("train", "-m", *fixed, "seed=choice(3)", "data.root=/a=b/c d/é")
    for words, name in here.items():
        lr = re.search(r"optimizer.lr=(\S+)", words)[1]
        assert re.fullmatch(rf"optimizer\.lr-{lr}-seed-3-[0-9a-f]{{8}}", name)
    assert (
        folders("train", "-m", *fixed, "seed=choice(3)", "data.root=/a=b/c d/é") == here
    )  # jobs go on where they stopped
    other = folders("train", "-m", *fixed, "seed=choice(3)", "data.root=/elsewhere")
    assert len({*here.values(), *other.values()}) == 4


def test_swept_paths_become_names(folders, tmp_path):
    paths = ["/data/my scenes (1)", "/data/" + "y" * 300, "/data/" + "y" * 301]
    names = folders("train", "-m", f"data.root={','.join(paths)}").values()
    assert len(set(names)) == 3 and all(re.fullmatch(r"[\w.-]{9,109}", name, re.ASCII) for name in names)
    for name in names:
        run = tmp_path / "sweep" / name
        checkpoints(run)[0].parent.mkdir()
        checkpoints(run)[0].touch()
        (word,) = prepare_arguments("export", ["ckpt"], [f"ckpt={run}", "out=x"])[:1]
        assert find_weights(parse_override(word).value(), None) == checkpoints(run)[0]


@pytest.mark.parametrize("words", [["-m", "seed=3"], ["-m"]])
def test_a_sweep_of_one_job_is_named_by_its_hash(words, folders):
    (name,) = folders("train", *words).values()
    assert re.fullmatch(r"[0-9a-f]{8}", name)


def test_the_sweeps_of_conf_keep_apart_whatever_else_is_swept(folders):
    words = ("sweep=strategies", "ckpt=demo", "strategy=ngd", "budget.views=5,6", "~hydra.callbacks.table")
    found = folders("distill", *words, "seed=0", "minutes=1")
    assert len(set(found.values())) == 2
    later = folders("distill", *words, "seed=0", "minutes=2")  # goes on where the minutes were spent
    assert sorted(later.values()) == sorted(found.values())


def test_long_names_end_in_their_hash():
    name = job_folder("k=" + "z" * 500, ["k=1"])
    assert len(name) == 109 and name != job_folder("k=" + "z" * 501, ["k=1"])
