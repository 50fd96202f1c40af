import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from nerfdiff.metrics.predictions import (
    NonFinitePrediction,
    PredictionWriter,
    read_plan,
    read_prediction,
)
from nerfdiff.utils.errors import DataError

IDENTITY = {"config_sha256": "aa", "seed": 0}


def images(n=2, seed=0):
    return torch.rand(n, 3, 6, 8, generator=torch.Generator().manual_seed(seed))


def writer(root, scenes=("a", "b"), identity=IDENTITY):
    return PredictionWriter(root, "none", scenes, identity)


def test_what_is_written_is_read_back(tmp_path):
    rgb, depth, opacity = images(), 1 + torch.rand(2, 6, 8), torch.rand(2, 6, 8)
    folder = writer(tmp_path).write("a", ("000003", "000007"), rgb, ("000064",), depth, opacity, cost={"encode_s": 0.5})
    assert folder == tmp_path / "none" / "a"
    assert sorted(p.name for p in (folder / "rgb").iterdir()) == ["000003.png", "000007.png"]
    back = read_prediction(tmp_path / "none", "a")
    assert back.views == ("000003", "000007") and back.source_views == ("000064",)
    assert back.cost == {"encode_s": 0.5}
    assert (back.pixels.float() - rgb * 255).abs().max() <= 0.5 + 1e-4
    assert torch.equal(back.depth, depth) and torch.equal(back.opacity, opacity)
    stored = np.array(Image.open(folder / "rgb" / "000007.png"))
    assert stored.shape == (6, 8, 3) and stored[2, 5, 1] == round(rgb[1, 1, 2, 5].item() * 255)


def test_an_interrupted_evaluation_goes_on_with_the_next_scene(tmp_path):
    first = writer(tmp_path, scenes=("a", "b", "c"))
    assert first.pending() == ("a", "b", "c")
    first.write("a", ("0", "1"), images())
    assert writer(tmp_path, scenes=("a", "b", "c")).pending() == ("b", "c")


def test_a_scene_that_failed_halfway_is_not_there(tmp_path, monkeypatch):
    predictions = writer(tmp_path)
    save, saved = Image.Image.save, []

    def full_disk(image, path, *args):
        if saved:
            raise OSError(28, "No space left on device")
        saved.append(path)
        save(image, path, *args)

    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(DataError, match=r"none/a: No space left on device"):
        predictions.write("a", ("0", "1"), images())
    assert len(saved) == 1
    assert [p.name for p in (tmp_path / "none").iterdir()] == ["plan.json"]
    assert predictions.pending() == ("a", "b")


def test_a_scene_can_be_written_again(tmp_path):
    predictions = writer(tmp_path)
    predictions.write("a", ("0", "1"), images(seed=1))
    predictions.write("a", ("0",), images(n=1, seed=2))
    assert read_prediction(tmp_path / "none", "a").views == ("0",)


def test_a_scene_is_made_by_one_process(tmp_path):
    """Another process holds the first of three scenes; the second is complete. Then it dies."""
    predictions = writer(tmp_path, scenes=("a", "b", "c"))
    predictions.write("b", ("0", "1"), images())
    hold = "import fcntl, sys; f = open(sys.argv[1], 'a+b'); fcntl.lockf(f, fcntl.LOCK_EX, 1, 0); print(); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    other = subprocess.Popen([sys.executable, "-c", hold, str(tmp_path / "none" / ".claims")], **pipes)
    other.stdout.readline()
    assert [predictions.claim(scene) for scene in "abc"] == [False, False, True]
    predictions.release("c")
    other.kill()
    assert predictions.claim("a", wait=True)
    other.communicate()


def test_a_plan_that_a_power_cut_emptied_is_made_anew(tmp_path):
    writer(tmp_path)
    (tmp_path / "none" / "plan.json").write_text("")
    predictions = writer(tmp_path)
    assert read_plan(tmp_path / "none")["scenes"] == ["a", "b"]
    predictions.write("a", ("0", "1"), images())
    (tmp_path / "none" / "plan.json").write_text("")
    with pytest.raises(DataError, match=r"plan\.json"):  # whose predictions these are, nobody knows
        writer(tmp_path)


def test_predictions_of_two_models_are_not_mixed(tmp_path):
    writer(tmp_path)
    with pytest.raises(DataError, match=r"config_sha256: 'aa' there, 'bb' now.*choose another folder"):
        writer(tmp_path, identity=IDENTITY | {"config_sha256": "bb"})
    with pytest.raises(DataError, match="2 scenes there"):
        writer(tmp_path, scenes=("a", "c"))
    assert read_plan(tmp_path / "none")["identity"] == IDENTITY


def test_non_finite_predictions_are_refused(tmp_path):
    broken = images()
    broken[1, 0, 2, 2] = torch.nan
    predictions = writer(tmp_path)
    with pytest.raises(NonFinitePrediction, match="scene a: 1 of 2 predicted views are not finite, first 1"):
        predictions.write("a", ("0", "1"), broken)
    assert predictions.pending() == ("a", "b")


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden"])
def test_names_that_are_no_file_names_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="cannot name a file"):
        writer(tmp_path, scenes=(name,))


def test_scenes_outside_the_plan_are_refused(tmp_path):
    with pytest.raises(DataError, match="'z' is not one of the scenes"):
        writer(tmp_path).write("z", ("0", "1"), images())


def test_damaged_files_are_named(tmp_path):
    folder = writer(tmp_path).write("a", ("0", "1"), images(), (), torch.ones(2, 6, 8), torch.ones(2, 6, 8))
    (folder / "depth" / "1.npz").write_bytes(b"PK")
    with pytest.raises(DataError, match=r"depth/1\.npz"):
        read_prediction(tmp_path / "none", "a")
    whole = (folder / "rgb" / "0.png").read_bytes()
    (folder / "rgb" / "0.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"rgb/0\.png"):
        read_prediction(tmp_path / "none", "a")
    (folder / "scene.json").write_text("{")
    with pytest.raises(DataError, match=r"scene\.json"):
        read_prediction(tmp_path / "none", "a")
    (folder / "scene.json").write_text(json.dumps({"format": 99}))
    with pytest.raises(DataError, match="format 99, expected 2"):
        read_prediction(tmp_path / "none", "a")
