"""What a row leaves for TensorBoard, read back from its files and asked of TensorBoard's own server."""

import json
import math
from pathlib import Path
from urllib.request import Request, urlopen

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image
from tensorboard import program
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import api_pb2, metadata

from nerfdiff.cli import load_config
from nerfdiff.evaluation.dashboard import Dashboard, accuracy_layout, show_in_dashboard, show_picture
from nerfdiff.metrics.predictions import PredictionWriter
from nerfdiff.results.row import ResultRow

LAYOUT = {"Accuracy": {"PSNR": ["accuracy/1_psnr"]}, "Distillation": {"agreement": ["distill/agreement"]}}


def config(home: Path):
    return OmegaConf.create({"results": str(home / "results.jsonl"), "seed": 0, "hydra": {"not": "shown"}})


def row(home: Path, seed: int = 0, **more) -> ResultRow:
    """A row of two scenes, with the files that it is about."""
    folder = home / f"job{seed}" / "ngd-0123abcd"
    predictions, scores = folder / "predictions" / "ngd", folder / "scores" / "ngd"
    scores.mkdir(parents=True, exist_ok=True)
    for scene, agreement in (("a", (10.0, 20.0)), ("b", (30.0, 50.0))):
        (predictions / scene).mkdir(parents=True, exist_ok=True)
        lines = [f"{step},0.5,,0.1,0.1,{value}" for step, value in enumerate(agreement)]
        text = "\n".join(["step,t,weight,loss_first,loss_last,agreement", *lines])
        (predictions / scene / "trace.csv").write_text(text + "\n")
    PredictionWriter(predictions.parent, "ngd", ["a", "b"], {})
    columns = "psnr,ssim,ssim_gaussian,lpips,st_lpips_vgg,sharpness,depth_abs_rel,depth_rmse,mask_iou"
    whole = "floaters,depth_extent,consistency_psnr,consistency_psnr_truth"
    lines = [f"{name},{psnr},.9,,,,,,,,,,," for name, psnr in (("a", 21.5), ("b", 22.5))]
    (scores / "per_scene.csv").write_text("\n".join([f"scene,{columns},{whole}", *lines]) + "\n")
    values = {
        "run_id": "x",
        "folder": str(folder.relative_to(home)),
        "strategy": "ngd",
        "overrides": ["strategy=ngd", f"seed={seed}", "+budget.steps=16", "data.root=/there", "~sheet"],
        "command": "python src/distill.py strategy=ngd",
        "seed": seed,
        "K": 25,
        "n_scenes": 2,
        "psnr": 22.0 + seed,
        "fd_st_vgg": math.nan,
        "denoiser_calls": 100,
        "scene_s": {"n": 2, "median": 3.5, "iqr": 0.1},
    }
    return ResultRow(**values | more)


def read(folder: Path) -> EventAccumulator:
    assert len(list(folder.glob("events.*"))) == 1
    return EventAccumulator(str(folder)).Reload()


def scalars(events: EventAccumulator) -> dict[str, list[float]]:
    return {tag: [value.value for value in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def text(events: EventAccumulator, tag: str) -> str:
    return events.Tensors(f"{tag}/text_summary")[0].tensor_proto.string_val[0].decode()


def session_status(events: EventAccumulator) -> int:
    content = events.PluginTagToContent(metadata.PLUGIN_NAME)[metadata.SESSION_END_INFO_TAG]
    return metadata.parse_session_end_info_plugin_data(content).status


def test_a_row_becomes_a_run_with_its_settings_numbers_text_and_pictures(tmp_path):
    sheet = tmp_path / "sheet.png"
    Image.fromarray(np.full((5, 7, 3), 9, np.uint8)).save(sheet)
    dashboard = Dashboard(["data"], LAYOUT)
    for _ in range(2):  # again, as a command that is repeated would: in place of the first
        dashboard.write(config(tmp_path), row(tmp_path), sheet)
    events = read(tmp_path / "tensorboard" / "ngd seed=0 budget.steps=16")
    found = {tag: values for tag, values in scalars(events).items() if not tag.startswith(("distill/", "scenes/"))}
    assert found == {"accuracy/1_psnr": [22.0], "cost/scene_s": [3.5], "counts/denoiser_calls": [50.0]}
    start = metadata.parse_session_start_info_plugin_data(
        events.PluginTagToContent(metadata.PLUGIN_NAME)[metadata.SESSION_START_INFO_TAG]
    )
    hparams = {name: getattr(value, value.WhichOneof("kind")) for name, value in start.hparams.items()}
    assert hparams == {"kind": "distillation", "strategy": "ngd", "K": 25.0, "seed": 0.0, "budget.steps": 16.0}
    assert session_status(events) == api_pb2.STATUS_SUCCESS
    (image,) = events.Images("accuracy/pictures")
    assert (image.width, image.height) == (7, 5)
    assert "python src/distill.py strategy=ngd" in text(events, "about")
    assert "| accuracy/1_psnr | 22 |" in text(events, "about")
    assert "seed: 0" in text(events, "config") and "not: shown" not in text(events, "config")


def test_curves_are_means_over_scenes_by_step_and_values_scene_by_scene(tmp_path):
    Dashboard([], LAYOUT).write(config(tmp_path), row(tmp_path), None)
    (folder,) = (tmp_path / "tensorboard").iterdir()  # one entry for the run
    curves = scalars(read(folder))
    assert curves["distill/agreement"] == [20.0, 35.0] and curves["scenes/psnr"] == [21.5, 22.5]
    assert "distill/weight" not in curves and "scenes/lpips" not in curves


def test_a_lost_scene_leaves_the_others_their_curve(tmp_path):
    lost = row(tmp_path)
    trace = tmp_path / lost.folder / "predictions" / "ngd" / "a" / "trace.csv"
    trace.write_text("step,t,weight,loss_first,loss_last,agreement\n0,0.5,,nan,nan,nan\n")
    Dashboard((), LAYOUT).write(config(tmp_path), lost, None)
    (folder,) = (tmp_path / "tensorboard").iterdir()
    assert scalars(read(folder))["distill/agreement"] == [30.0, 50.0]


def test_a_failed_run_is_shown_as_one(tmp_path):
    early = ResultRow(run_id="x", status="oom", strategy="ngd", overrides=["seed=3"], error="no | room")
    Dashboard([], LAYOUT).write(config(tmp_path), early, None)
    (folder,) = (tmp_path / "tensorboard" / "failed").iterdir()
    events = read(folder)
    assert session_status(events) == api_pb2.STATUS_FAILURE and not scalars(events)
    assert r"| error | no \| room |" in text(events, "about")
    late = row(tmp_path, status="nan")
    Dashboard([], LAYOUT).write(config(tmp_path), late, None)
    assert not scalars(read(next((tmp_path / "tensorboard").glob("ngd *")))).keys() & {"distill/agreement"}


def test_runs_are_called_by_what_tells_them_apart_and_keep_to_themselves(tmp_path):
    dashboard = Dashboard(["data", "seed"], LAYOUT)
    for one in (row(tmp_path), row(tmp_path, strategy="copy_input", status="error")):
        dashboard.write(config(tmp_path), one, None)
    words = ["ckpt=/far/away/run_7/", "budget.rays=2048", "strategy.name='a b/c'", f"x={'y' * 200}"]
    dashboard.write(config(tmp_path), row(tmp_path, overrides=words[:3]), None)
    dashboard.write(config(tmp_path), row(tmp_path, overrides=words), None)
    runs = sorted(path.parent.name for path in tmp_path.rglob("events.*"))
    assert runs[0] == "copy_input budget.steps=16" and runs[2] == "ngd ckpt=run_7 budget.rays=2048 strategy.name=c_"
    assert runs[1] == "ngd budget.steps=16" and runs[3].startswith(runs[2] + " x=yyy") and len(runs[3]) < 120
    # the same words about other files: not in place of the first
    other = row(tmp_path, folder="elsewhere/ngd-4567", status="error", psnr=5.0)
    for _ in range(2):
        dashboard.write(config(tmp_path), other, None)
    (second,) = (path.parent for path in tmp_path.rglob("events.*") if path.parent.name not in runs)
    assert second.name.startswith("ngd budget.steps=16 ") and scalars(read(second))["accuracy/1_psnr"] == [5.0]
    assert scalars(read(second.parent / "ngd budget.steps=16"))["accuracy/1_psnr"] == [22.0]


def test_a_picture_has_an_entry(tmp_path):
    cfg = load_config("picture", [f"out={tmp_path}", "strategy=none", "paths.output_dir=none"])
    Image.fromarray(np.full((5, 7, 4), 9, np.uint8)).save(tmp_path / "views.png")
    trace = tmp_path / "trace.csv"
    trace.write_text("step,t,weight,loss_first,loss_last,agreement\n0,0.5,,0.1,0.1,20\n1,0.4,,0.1,0.1,22\n")
    show_picture(cfg, tmp_path, "car", {"picture": "my car.jpg", "status": "ok"}, tmp_path / "views.png", trace)
    events = read(tmp_path / "tensorboard" / "picture" / "car strategy=none")
    assert len(events.Images("accuracy/pictures")) == 1 and scalars(events)["distill/agreement"] == [20.0, 22.0]
    assert "| picture | my car.jpg |" in text(events, "about") and "elevation: null" in text(events, "config")
    start = metadata.parse_session_start_info_plugin_data(
        events.PluginTagToContent(metadata.PLUGIN_NAME)[metadata.SESSION_START_INFO_TAG]
    )
    assert start.hparams["kind"].string_value == "picture" and session_status(events) == api_pb2.STATUS_SUCCESS
    show_picture(load_config("picture", ["dashboard=null"]), tmp_path, "van", {}, None)
    assert len(list((tmp_path / "tensorboard" / "picture").iterdir())) == 1


@pytest.mark.parametrize("command", ["evaluate", "distill"])
def test_the_configured_layout_names_tags_that_are_written(command, tmp_path):
    cfg = load_config(command, ["ckpt=demo", f"paths.output_dir={tmp_path}"])
    measured = {"st_lpips_vgg": 0.1, "lpips": 0.2, "fid": 3.0, "fd_st_vgg": 4.0}
    timings = {f"{name}_s": {"n": 1, "median": 1.0, "iqr": 0.0} for name in ("denoise", "fit", "guide")}
    one = row(tmp_path, **measured, **timings)
    scores = tmp_path / one.folder / "scores" / "ngd" / "per_scene.csv"
    scores.write_text(scores.read_text().replace(",.9,,,", ",.9,,,0.3"))
    show_in_dashboard(cfg, [one])
    written = set()
    for path in tmp_path.rglob("events.*"):
        written |= set(EventAccumulator(str(path.parent)).Reload().Tags()["scalars"])
    layout = accuracy_layout() | dict(cfg.dashboard.layout)
    shown = {tag for charts in layout.values() for tags in charts.values() for tag in tags}
    assert shown - written == {"accuracy/2_ssim", "scenes/lpips"}  # which were not measured here


def test_no_dashboard_and_one_that_cannot_be_written_cost_no_run(tmp_path, caplog):
    cfg = load_config("evaluate", ["ckpt=demo", f"paths.output_dir={tmp_path}", "dashboard=null"])
    show_in_dashboard(cfg, [row(tmp_path)])
    assert not (tmp_path / "tensorboard").exists()
    (tmp_path / "tensorboard").write_text("no folder")
    show_in_dashboard(load_config("evaluate", ["ckpt=demo", f"paths.output_dir={tmp_path}"]), [row(tmp_path)])
    assert "cannot be written" in caplog.text


def test_tensorboard_itself_compares_the_runs(tmp_path):
    """Its HPARAMS tab has a line for each row with all columns, and its first screen is ours."""
    dashboard = Dashboard([], LAYOUT)
    dashboard.write(config(tmp_path), row(tmp_path), None)
    dashboard.write(config(tmp_path), row(tmp_path, seed=1, overrides=["strategy=ngd", "budget.rays=64"]), None)
    server = program.TensorBoard()
    server.configure(argv=["", "--logdir", str(tmp_path / "tensorboard"), "--port", "0", "--load_fast", "false"])
    url = server.launch()

    def ask(path, question=None):
        data = None if question is None else json.dumps(question).encode()
        headers = {"Content-Type": "application/json"}
        with urlopen(Request(f"{url}data/{path}", data, headers), timeout=60) as answer:
            return json.loads(answer.read())

    layout = ask("plugin/custom_scalars/layout")
    charts = {c["title"]: c["multiline"]["tag"] for category in layout["category"] for c in category["chart"]}
    assert charts == {"PSNR": ["accuracy/1_psnr"], "agreement": ["distill/agreement"]}  # each once for all runs
    experiment = ask("plugin/hparams/experiment", {"experimentName": ""})
    assert {info["name"] for info in experiment["hparamInfos"]} >= {"strategy", "K", "budget.steps", "budget.rays"}
    metrics = ["accuracy/1_psnr", "cost/scene_s", "counts/denoiser_calls"]
    assert sorted(info["name"]["tag"] for info in experiment["metricInfos"])[:3] == metrics
    wanted = {"allowedStatuses": ["STATUS_SUCCESS"], "startIndex": 0, "sliceSize": 10}
    columns = [{"metric": {"tag": tag}} for tag in metrics]
    groups = ask("plugin/hparams/session_groups", wanted | {"colParams": columns})["sessionGroups"]
    found = []
    for group in groups:
        values = {value["name"]["tag"]: value["value"] for value in group["metricValues"]}
        found.append((group["hparams"].get("budget.rays"), values["accuracy/1_psnr"], values["cost/scene_s"]))
    assert sorted(found, key=str) == [(64, 23.0, 3.5), (None, 22.0, 3.5)]
