"""A field alone on some rays, then the CDM alone on its kept renderings."""

import shutil
import sqlite3

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from model_fixtures import config
from nerfdiff.averages import average_of
from nerfdiff.checkpoint import export, load_model
from nerfdiff.data.batch import ViewBatch
from nerfdiff.training.kept_renderings import KeptRenderings
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.utils.errors import CheckpointError, ConfigError
from training_fixtures import last_checkpoint, run_training, write_dataset

OPTIMIZER = {"lr": 1e-3, "weight_decay": 0.0, "betas": [0.9, 0.99], "warmup_steps": 0, "decay": "none"}
FIELD = ["losses.lambda_dm=0", "losses.through_rendering=false", "losses.ray_share=0.25"]


def module(losses, **options) -> NerfDiffModule:
    torch.manual_seed(0)
    made = NerfDiffModule(config(), {"lambda_ic": 1, "lambda_dm": 1} | losses, OPTIMIZER, [0.5], False, 0, **options)
    made.log = made.log_dict = lambda *args, **kwargs: None
    torch.nn.init.normal_(made.model.denoiser.unet.conv_out.weight, std=0.1)  # else no gradient gets past it
    return made


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def batch(data) -> ViewBatch:
    from nerfdiff.data.draws import Draws
    from nerfdiff.data.readers.srn import SRNReader
    from nerfdiff.data.views import TrainingViews

    reader = SRNReader(root=data, split="train", image_size=[8, 8], category="cars", near=0.8, far=1.8)
    views = TrainingViews(reader, Draws(0, len(reader), 2, 0.0))
    return ViewBatch.collate([views[draw] for draw in range(2)])


def gradients(made: NerfDiffModule, batch: ViewBatch) -> dict[str, torch.Tensor]:
    made.training_step(batch, 0).backward()
    return {name: p.grad for name, p in made.model.named_parameters() if p.grad is not None}


def parts(names) -> set[str]:
    return {name.partition(".")[0] for name in names}


def test_each_part_can_be_trained_alone(batch):
    assert parts(gradients(module({"lambda_dm": 0}), batch)) == {"encoder", "decoder"}
    assert parts(gradients(module({"lambda_ic": 0}), batch)) == {"denoiser"}


def test_all_rays_in_another_order_give_the_same_loss(batch):
    made = module({"lambda_dm": 0})
    encoding = made.model.encode(batch)
    every = torch.stack([torch.randperm(2 * 64, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2)])
    jitter = torch.full((2, 128, made.model.renderer.samples_per_ray), 0.5)
    some = made._on_some_rays(batch, encoding, every, jitter)
    rendered = made.model.render(encoding, batch.target_cameras, jitter).images
    torch.testing.assert_close(some, F.mse_loss(rendered, batch.targets))
    # a ray's own colour: the loss on one ray is that pixel's error
    one = made._on_some_rays(batch, encoding, torch.tensor([[70], [70]]), jitter[:, :1])
    view, pixel = divmod(70, 64)
    error = (rendered - batch.targets)[:, view, :, pixel // 8, pixel % 8]
    torch.testing.assert_close(one, error.square().mean())


def test_without_the_way_through_the_rendering_the_field_has_no_gradient_of_the_cdm(batch):
    """The photometric loss is the same, so what differs in the encoder is the CDM's part."""
    through, apart = (gradients(module({"through_rendering": way}), batch) for way in (True, False))
    name = "decoder.output.weight"  # the encoder also gets the CDM's gradient by cross-attention
    alone = gradients(module({"lambda_dm": 0}), batch)
    torch.testing.assert_close(apart[name], alone[name])
    assert not torch.allclose(through[name], alone[name])


def test_a_share_of_rays_that_rounds_to_all_is_all(batch):
    whole, rounded = (gradients(module({"lambda_dm": 0, "ray_share": share}), batch) for share in (1, 0.999))
    assert whole.keys() == rounded.keys()


def test_every_target_has_a_time_of_its_own(batch, monkeypatch):
    seen = []
    made = module({})
    velocity = made.model.denoiser.velocity
    monkeypatch.setattr(
        made.model.denoiser, "velocity", lambda z, t, c: (seen.extend(t.tolist()), velocity(z, t, c))[1]
    )
    made.training_step(batch, 0)
    assert len(set(seen)) == 4  # two draws of two targets


def test_kept_renderings_are_what_would_be_rendered(batch, tmp_path):
    plain, keeping = module({"lambda_ic": 0}), module({"lambda_ic": 0}, kept_renderings=str(tmp_path))
    encoding = plain.model.encode(batch)
    with torch.no_grad():
        rendered = plain._rendered(batch, encoding)
        first, second = keeping._rendered(batch, encoding), keeping._rendered(batch, encoding)
    torch.testing.assert_close(first, rendered, atol=0.5 / 255 + 1e-5, rtol=0)
    assert torch.equal(first, second)
    with sqlite3.connect(keeping.kept.path) as file:
        assert file.execute("SELECT count(*) FROM checked").fetchone() == (4,)


def test_kept_renderings_are_made_once(tmp_path):
    made = []

    def render(missing):
        made.append(missing)
        return torch.stack([torch.full((3, 2, 4), position / 4) for position in missing])

    kept = KeptRenderings(tmp_path)
    kept.get(["a", "b"], (2, 4), render)
    again = KeptRenderings(tmp_path).get(["b", "c", "a"], (2, 4), render)
    assert made == [[0, 1], [1]]
    assert (again[:, 0, 0, 0] * 4).round().tolist() == [1, 1, 0]
    with pytest.raises(CheckpointError, match=r"renderings\.sqlite.*delete this folder"):
        kept.get(["a"], (3, 3), render)


@pytest.mark.parametrize(
    ("losses", "message"),
    [
        ({"lambda_ic": 0, "lambda_dm": 0}, "nor both be 0"),
        ({"ray_share": 0}, "expected a share above 0"),
        ({"ray_share": 0.5}, r"losses\.through_rendering=false"),
    ],
)
def test_losses_that_cannot_be(losses, message):
    with pytest.raises(ConfigError, match=message):
        module(losses)


def test_two_phases_as_a_person_runs_them(data, tmp_path):
    field = tmp_path / "field"
    run_training(data, field, *FIELD, "data.about=tests")
    more = [
        "losses.lambda_ic=0",
        f"init={field}",
        f"kept_renderings={tmp_path / 'kept'}",
        "data.train_source_views=1",
        "optimizer.decay=none",
        "data.about=tests",
    ]
    run_training(data, tmp_path / "cdm", *more)
    before, after = (load_model(run, "raw", "assets").model.state_dict() for run in (field, tmp_path / "cdm"))
    averaged = load_model(field, "ema", "assets").model.state_dict()
    for name, value in after.items():
        if name.startswith("denoiser.unet.conv_out"):
            assert not torch.equal(value, before[name])  # trained
        elif not name.startswith("denoiser"):
            assert torch.equal(value, averaged[name]), name  # the field as it was given
    (kept,) = (tmp_path / "kept").glob("*/*/renderings.sqlite")
    with sqlite3.connect(kept) as file:
        names = [name for (name,) in file.execute("SELECT name FROM checked")]
    assert names and all(name.split("/")[1] == "000000" for name in names)  # one source view of each scene

    # what it was trained on goes with it
    phases = load_model(tmp_path / "cdm" / "model", "ema").trained_on
    assert [(p["part"], p["images"], p["scenes"], p["about"]) for p in phases] == [
        ("field", 24, 3, "tests"), ("CDM", 24, 3, "tests")
    ]  # fmt: skip
    assert (
        "24 images for the field of 3 scenes of srn_cars (tests), then 24 images for the CDM"
        in load_model(tmp_path / "cdm", "ema").describe()
    )

    # stopped and resumed: the same bits, whatever is kept already
    half = tmp_path / "half"
    run_training(data, half, *more, "trainer.max_steps=3")
    shutil.rmtree(tmp_path / "kept")
    run_training(data, half, *more)
    whole, resumed = last_checkpoint(tmp_path / "cdm"), last_checkpoint(half)
    for name, value in whole["current_model_state"].items():
        assert torch.equal(value, resumed["current_model_state"][name]), name


def test_kept_renderings_need_a_field_that_stays(data, tmp_path):
    with pytest.raises(ConfigError, match="init=<checkpoint>"):
        run_training(data, tmp_path / "a", "losses.lambda_ic=0", f"kept_renderings={tmp_path}")
    moving = ["losses.lambda_ic=0", "init=demo", f"kept_renderings={tmp_path}", "data.source_target_noise=0.3"]
    with pytest.raises(ConfigError, match=r"data\.source_target_noise=0\.3 moves"):
        run_training(data, tmp_path / "b", *moving)
    with pytest.raises(ConfigError, match=r"losses\.lambda_ic=0"):
        module({}, kept_renderings=str(tmp_path))


def test_a_model_to_begin_with_must_fit(data, tmp_path):
    with pytest.raises(CheckpointError, match=r"init=demo does not fit this run's model \(.*field\.channels: \d+ → 4"):
        run_training(data, tmp_path, "init=demo")


def test_a_run_goes_on_with_what_it_began_with(data, tmp_path):
    """Else its renderings would be of one field under the name of another."""
    for name in ("a", "b"):
        run_training(data, tmp_path / name, *FIELD, f"seed={'ab'.index(name)}", "trainer.max_steps=1")
    words = ["losses.lambda_ic=0", f"kept_renderings={tmp_path / 'kept'}"]
    with pytest.raises(ConfigError, match="set init=<checkpoint>"):
        run_training(data, tmp_path / "cdm", *words)
    run_training(data, tmp_path / "cdm", *words, f"init={tmp_path / 'a'}", "trainer.max_steps=1")
    with pytest.raises(CheckpointError, match="began with other weights than init="):
        run_training(data, tmp_path / "cdm", *words, f"init={tmp_path / 'b'}", "trainer.max_steps=2")
    run_training(data, tmp_path / "cdm", *words, f"init={tmp_path / 'a'}", "trainer.max_steps=2")
    run_training(data, tmp_path / "other", *words, f"init={tmp_path / 'b'}", "trainer.max_steps=1")
    assert len(list((tmp_path / "kept").glob("*/*/renderings.sqlite"))) == 2  # one for each field


def test_averages_are_of_the_model_they_are_exported_with(data, tmp_path):
    run = tmp_path / "run"
    settings = f"folder: {run / 'snapshots'}, every_n_steps: 1, lengths: [0.05, 0.1]"
    snapshots = "nerfdiff.training.callbacks.snapshots.Snapshots"
    run_training(data, run, f"callbacks.snapshots={{_target_: {snapshots}, {settings}}}")
    export(run, "ema", tmp_path / "out", "float32", None, average=0.1)
    made, expected = load_model(tmp_path / "out", "ema"), average_of(run / "snapshots", 0.1)
    assert made.trained_on[-1]["average"] == 0.1
    assert all(torch.equal(value, expected[name]) for name, value in made.model.named_parameters())
    save_file({"other": torch.zeros(1)}, run / "snapshots/step_0000006_0.1.safetensors", {"step": "6", "length": "0.1"})
    with pytest.raises(CheckpointError, match="of another model"):
        export(run, "ema", tmp_path / "out", "float32", None, average=0.1)
    (run / "snapshots/step_0000001_0.1.safetensors").write_bytes(b"x" * 99)
    with pytest.raises(CheckpointError, match="not a readable snapshot"):
        export(run, "ema", tmp_path / "out", "float32", None, average=0.1)
    settings = (tmp_path / "out/model.yaml").read_text()
    (tmp_path / "out/model.yaml").write_text(settings.replace("images: 24", "images: many"))
    with pytest.raises(CheckpointError, match="trained_on"):
        load_model(tmp_path / "out", "ema")
