import json
from pathlib import Path

import pytest
import torch

import field_speed
from harness import Work
from nerfdiff.model import build_on_meta
from pixel_fixtures import pixel_config
from subjects import Subject

TOY = ["--models", "tiny", "--size", "16", "--seconds", "0.001", "--device", "cpu", "--precision", "32-true"]
SMALL = ["model.unet.channel_mult=[1,2]", "model.render.uniform_samples=4", "model.render.importance_samples=4"]


def test_every_field_is_timed_encoding_and_rendering_in_one_run(tmp_path):
    content = json.loads(Path(field_speed.main([*SMALL, *TOY, "--rays", "32", "--out", str(tmp_path)])).read_text())
    rows = {(row["name"], row["setting"]["part"]): row for row in content["rows"]}
    fields = {"triplane, tiny", "pixelNeRF", "VisionNeRF"}
    assert {name for name, part in rows if part == "encode"} == fields
    assert {name for name, part in rows if part == "render"} == fields | {"triplane, tiny, plain PyTorch"}
    assert all(row["seconds"]["median"] > 0 and row["ratio"] > 0 for row in rows.values())
    assert all(row["more"]["s / ref."] == pytest.approx(1 / row["ratio"]) for row in rows.values())
    assert rows["triplane, tiny", "encode"]["ratio"] == rows["triplane, tiny, plain PyTorch", "render"]["ratio"] == 1
    for row in rows.values():
        if row["setting"]["part"] == "render":
            assert row["more"]["s per view"] == pytest.approx(row["seconds"]["median"] * 256 / 32)
    assert (rows["pixelNeRF", "encode"]["more"]["paper, s"], rows["pixelNeRF", "render"]["more"]["paper, s"]) == (
        0.007,
        1.639,
    )
    assert rows["VisionNeRF", "render"]["more"]["paper, / ref."] == pytest.approx(0.678 / 0.018)
    assert content["settings"] == {"pixels": 256, "rays": 32, "samples": [8]}
    work = {name: rows[name, "render"]["work"]["flops"] for name in ("triplane, tiny", "pixelNeRF")}
    assert work["pixelNeRF"] > 5 * work["triplane, tiny"]


def test_a_points_work_is_that_of_the_mlps_weights_and_of_one_gather():
    """Two layers of 16 take 32 channels: worked on whole maps, of 8 x 8 pixels."""
    config = pixel_config("pixelnerf")
    measured = Subject("toy", build_on_meta(config).to_empty(device="cpu"), config, 16, torch.device("cpu"), "32-true")
    per_point = 2 * ((3 + 18 + 3) * 16 + 6 * 16 * 16 + 16 * 4) + 8 * 32
    work = field_speed.rendering_work(measured, 10)
    assert work.flops == per_point * 12 * 10 + 2 * (32 * 32) * 8 * 8
    parameters = sum(p.numel() for p in measured.model.decoder.parameters())
    assert work == Work(work.flops, 4 * (32 * 8 * 8 + parameters + 130))


def test_a_single_model_is_refused():
    with pytest.raises(SystemExit):
        field_speed.main(["--ckpt", "demo"])
