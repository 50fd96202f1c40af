"""Training from memory, on a CPU, where its steps run one by one."""

import gc

import pytest
import torch
import torch.nn.functional as F

from model_fixtures import config
from nerfdiff.averages import average_of
from nerfdiff.checkpoint import load_model
from nerfdiff.cli import load_config
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.model import NerfDiff
from nerfdiff.training import resident
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.training.resident import Step, train_resident
from nerfdiff.training.resident_scenes import FrozenField, ResidentScenes, draw_table
from nerfdiff.utils.errors import ConfigError, DataError
from training_fixtures import run_training, write_dataset

SMALL = ["model.unet.channel_mult=[1,1]", "data.image_size=[12,12]", "conditioning=preconditioned"]


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A dataset, and a run on it to begin with."""
    folder = tmp_path_factory.mktemp("resident")
    data = write_dataset(folder / "data")
    run_training(data, folder / "run", "trainer.max_steps=1", *SMALL)
    return data, folder / "run"


def train(begun, out, *more):
    data, run = begun
    overrides = [
        f"init={run}",
        f"data.root={data}",
        "data.cache=false",
        "data.image_size=[12,12]",
        "data.batch_size=2",
        "data.target_views=2",
        "data.train_source_views=2",
        "steps=8",
        "minutes=10",
        "precision=32-true",
        "log_every_n_steps=1",
        f"paths.output_dir={out}",
    ]
    return train_resident(load_config("train_resident", [*overrides, *more]))


def test_draws_visit_every_scene_and_never_pair_a_view_with_itself_unless_asked():
    table = draw_table(seed=3, draws=60, scenes=5, views=6, targets=3, sources=2, source_as_target=0.0)
    for one in table.view(12, 5, 5):
        assert sorted(one[:, 0].tolist()) == [0, 1, 2, 3, 4]
    assert set(table[:, 1].tolist()) == {0, 1}
    for row in table[:, 1:].tolist():
        assert len(set(row)) == 4
    again = draw_table(seed=3, draws=400, scenes=5, views=6, targets=3, sources=6, source_as_target=0.25)
    assert 60 < (again[:, 1] == again[:, 2]).sum() < 140
    with pytest.raises(ConfigError, match=r"data\.target_views=6"):
        draw_table(0, 1, 1, 6, 6, 6, 0.0)


def scenes_of(data, side=12):
    reader = SRNReader(data, "cars", "train", 0.8, 1.8, image_size=side)
    return reader, ResidentScenes.read(reader, None, torch.device("cpu"))


@pytest.mark.parametrize("frozen", [True, False])
def test_the_loss_is_the_modules(begun, monkeypatch, frozen):
    """Against `NerfDiffModule` on the batch that the DataModule's collation makes of the same views."""
    from nerfdiff.data.batch import Sample, ViewBatch

    reader, scenes = scenes_of(begun[0])
    sizes = config(conditioning={"residual_std": 0.2}, render={"importance_samples": 0})
    table = torch.tensor([[2, 1, 3, 0], [0, 4, 1, 2]])
    torch.manual_seed(0)
    model = NerfDiff(**sizes)
    with torch.no_grad():
        for parameter in model.denoiser.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    eps = torch.randn(4, 3, 12, 12)
    monkeypatch.setattr(resident.torch, "randn_like", lambda like: eps)
    monkeypatch.setattr(resident.torch, "rand", lambda *shape, device: torch.full(shape, 0.5))
    autocast = torch.autocast("cpu", enabled=False)
    field = FrozenField(model, scenes, 5, 2, autocast) if frozen else None
    options = {"lr": 0.0, "weight_decay": 0.0, "betas": [0.9, 0.99]}
    step = Step(model, scenes, table, 2, field, options, 1.0, 7, autocast)
    losses = step._losses(table)

    loss = {"lambda_ic": 0.0 if frozen else 1.0, "lambda_dm": 1.0}
    module = NerfDiffModule(sizes, loss, options | {"warmup_steps": 0, "decay": "none"}, [0.5], False, 7)
    module.model.load_state_dict(model.state_dict())
    draws = enumerate(table.tolist())
    batch = ViewBatch.collate([Sample(reader.load(scene), view, rest, n) for n, (scene, view, *rest) in draws])
    encoding = module.model.encode(batch)
    rendered = module.model.render(encoding, batch.target_cameras).images
    expected = module._diffusion(batch, encoding, rendered, eps.unflatten(0, (2, 2)))
    # a frozen field's renderings are kept in fp16
    torch.testing.assert_close(losses["loss_dm"], expected, rtol=2e-2 if frozen else 1e-5, atol=0)
    if not frozen:
        torch.testing.assert_close(losses["loss_ic"], F.mse_loss(rendered, batch.targets), rtol=1e-4, atol=0)


def test_the_cdm_alone_is_trained_and_the_average_exported(begun, tmp_path):
    path = train(begun, tmp_path, "average=0.1")
    loaded, before = load_model(path.parent, "ema"), load_model(begun[1], "ema")
    for name, value in loaded.model.state_dict().items():
        same = torch.equal(value, before.model.state_dict()[name])
        assert same or name.startswith("denoiser."), name
    last = next(name for name in before.model.state_dict() if name.startswith("denoiser."))
    assert not torch.equal(loaded.model.state_dict()[last], before.model.state_dict()[last])
    for name, value in average_of(tmp_path / "snapshots", 0.1).items():
        assert torch.allclose(value, loaded.model.state_dict()[name], atol=1e-3), name
    seen = loaded.trained_on[-1]
    assert (seen["part"], seen["images"], seen["scenes"]) == ("CDM", 8 * 2 * 2, 3)
    # of 8 steps: the first at or after each share of the training
    files = {f"step_{step:07d}_{length}.safetensors" for step in (1, 2, 4, 8) for length in (0.05, 0.1)}
    assert {path.name for path in (tmp_path / "snapshots").iterdir()} == files


def test_joint_training_with_another_conditioning_and_a_new_cdm(begun, tmp_path):
    path = train(begun, tmp_path, "part=joint", "conditioning=rendered", "fresh_cdm=true", "steps=2")
    loaded, before = load_model(path.parent, "ema"), load_model(begun[1], "ema")
    assert loaded.model.denoiser.residual_std is None
    assert loaded.trained_on[-1]["part"] == "field and the CDM"
    changed = [
        not torch.equal(value, before.model.state_dict()[name])
        for name, value in loaded.model.state_dict().items()
        if name.startswith("encoder.") and value.numel() > 1
    ]
    assert sum(changed) > len(changed) / 2


def test_renderings_of_a_frozen_field_say_how_far_they_are(begun, caplog):
    _, scenes = scenes_of(begun[0])
    with caplog.at_level("INFO"):
        FrozenField(NerfDiff(**config()), scenes, 2, 3, torch.autocast("cpu", enabled=False), every_seconds=0)
    assert "renderings of the frozen field: 50 % made" in caplog.text


def test_draws_that_come_again_have_other_times(begun, monkeypatch):
    """The table has two steps; the golden-ratio sequence of times goes on."""
    _, scenes = scenes_of(begun[0])
    seen = []
    times = resident.spread_times
    monkeypatch.setattr(resident, "spread_times", lambda draws, seed: seen.append(times(draws, seed)) or seen[-1])
    torch.manual_seed(0)
    table = torch.tensor([[0, 1, 2], [1, 0, 2]])
    autocast = torch.autocast("cpu", enabled=False)
    step = Step(
        NerfDiff(**config()),
        scenes,
        table,
        1,
        None,
        {"lr": 1e-3, "weight_decay": 0.0, "betas": [0.9, 0.99]},
        1.0,
        7,
        autocast,
    )
    for _ in range(5):
        step.run(1e-3)
    assert step.taken == 5 and len({float(t) for t in seen}) == 5


def test_it_learns(begun, tmp_path):
    """The mean loss of the last quarter is well below that of the first."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(begun, tmp_path, "steps=60", "optimizer.lr=2e-3", "optimizer.warmup_steps=1", "fresh_cdm=true")
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    loss = [event.value for event in events.Scalars("train/loss_dm")]
    assert sum(loss[-15:]) < 0.8 * sum(loss[:15])


def test_what_cannot_be_trained(begun, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="part=field"):
        train(begun, tmp_path, "part=field")
    with pytest.raises(ConfigError, match="snapshots"):
        train(begun, tmp_path, "snapshots=[0.5,1.5]")
    wrong = {
        "average=0.2": r"average=0.2 is none of the lengths=\[0.05, 0.1\]",
        "precision=16-mixed": "precision=16-mixed",
        "optimizer.decay=linear": "optimizer.decay",
        "data.source_target_noise=0.3": "data.source_target_noise",
        "data.train_source_view=3": "data.train_source_view",
        "conditioning=concat": "another CDM than conditioning=concat needs: set fresh_cdm=true",
    }
    for setting, words in wrong.items():
        with pytest.raises(ConfigError, match=words):
            train(begun, tmp_path, setting)
    reader, _ = scenes_of(begun[0])
    whole = reader.load
    monkeypatch.setattr(reader, "load", lambda index: whole(index, range(5 - (index == 1))))
    with pytest.raises(DataError, match=r"equally many views, and these have \[4, 5\]"):
        ResidentScenes.read(reader, None, torch.device("cpu"))


@pytest.mark.parametrize(("frozen", "backend"), [(True, "torch"), (False, "torch"), (False, "triton")])
def test_a_step_leaves_nothing_that_only_the_garbage_collector_finds(begun, frozen, backend):
    """Autograd's nodes among it would belong to another stream than the one on which a CUDA graph is recorded."""
    _, scenes = scenes_of(begun[0])
    torch.manual_seed(0)
    model = NerfDiff(**config(render={"backend": backend, "uniform_samples": 4, "importance_samples": 2}))
    autocast = torch.autocast("cpu", enabled=False)
    field = FrozenField(model, scenes, 2, 2, autocast) if frozen else None
    options = {"lr": 1e-3, "weight_decay": 0.0, "betas": [0.9, 0.99]}
    step = Step(model, scenes, torch.tensor([[0, 1, 3]]), 1, field, options, 1.0, 7, autocast)
    step.run(1e-3)
    gc.collect()
    gc.disable()
    try:
        step.run(1e-3)
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        assert not [one for one in gc.garbage if isinstance(one, torch.Tensor) and one.grad_fn is not None]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def test_of_a_recording_that_broke_the_first_cause_is_named(begun, tmp_path, monkeypatch, caplog):
    def broken(step):
        try:
            raise RuntimeError("operation not permitted\nwhere it happened")
        finally:
            raise RuntimeError("previous error during capture")

    monkeypatch.setattr(Step, "capture", broken)
    monkeypatch.setattr(resident, "_records", lambda step: True)
    train(begun, tmp_path, "steps=2", "eager_steps=1")
    assert "operation not permitted; then previous error during capture" in caplog.text
