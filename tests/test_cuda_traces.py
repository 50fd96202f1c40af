"""Training, evaluation and distillation as on a GPU, traced without one: devices and types fit."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from fake_cuda import DEVICE, fake_cuda
from model_fixtures import config
from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.sampler import SamplerSettings
from nerfdiff.distill.cdm import CDMSampling
from nerfdiff.distill.direct import DirectTeacher
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.ngd import Guidance, NGDTeacher
from nerfdiff.distill.none import SingleImageNeRF
from nerfdiff.distill.sds import SDSTeacher
from nerfdiff.distill.stochastic import StochasticTeacher
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.fit.objective import Objective
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.settings import FitSettings
from nerfdiff.model import NerfDiff
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.training.resident import Step
from nerfdiff.training.resident_scenes import FrozenField, ResidentScenes

SIDE = 8
OPTIMIZER = {"lr": 1e-3, "weight_decay": 0.01, "betas": [0.9, 0.99]}
BACKENDS = pytest.mark.parametrize("backend", ["auto", "torch"])  # kernels, and the reference


def sizes(backend: str, preconditioned: bool = False) -> dict:
    changes = {"residual_std": 0.2} if preconditioned else {"ray_maps": True}
    own = {"backend": backend, "uniform_samples": 4, "importance_samples": 4}
    return config(render=own, conditioning=changes, unet={"attention_downsampling": [1, 2]})


def cameras(*shape: int) -> Cameras:
    K = torch.tensor([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    return Cameras(torch.eye(4).expand(*shape, 4, 4).clone(), K.expand(*shape, 3, 3).clone(), SIDE, SIDE)


def views(batch: int, targets: int = 2) -> ViewBatch:
    pixels = torch.zeros(batch, 1 + targets, 3, SIDE, SIDE, dtype=torch.uint8)
    made = ViewBatch(
        draws=torch.arange(batch),
        source_pixels=pixels[:, 0],
        source_cameras=cameras(batch),
        target_pixels=pixels[:, 1:],
        target_cameras=cameras(batch, targets),
        near=torch.full((batch,), 0.8),
        far=torch.full((batch,), 1.8),
        scene_ids=("scene",) * batch,
        source_views=("0",) * batch,
        target_views=(("1",) * targets,) * batch,
    )
    return made.to(DEVICE)


def made(settings: dict) -> NerfDiff:
    with torch.device("cpu"):
        model = NerfDiff(**settings)
    return model.to(memory_format=torch.channels_last).to(DEVICE)


def bf16():
    return torch.autocast("cuda", torch.bfloat16, cache_enabled=False)


@BACKENDS
@pytest.mark.parametrize("preconditioned", [False, True])
@pytest.mark.parametrize("part", ["joint", "some rays", "field", "frozen field"])
def test_a_training_step(part, preconditioned, backend):
    losses = {"lambda_ic": 0.0 if part == "frozen field" else 1.0, "lambda_dm": 0.0 if part == "field" else 1.0}
    if part == "some rays":
        losses |= {"ray_share": 0.25, "through_rendering": False}
    with fake_cuda() as gpu:
        options = OPTIMIZER | {"warmup_steps": 0, "decay": "none"}
        module = NerfDiffModule(sizes(backend, preconditioned), losses, options, [0.5], True, 0).to(DEVICE)
        module.log = module.log_dict = lambda *args, **options: None
        batch = views(2)
        gpu.copies.clear()
        with bf16():
            loss = module.training_step(batch, 0)
        loss.backward()
        assert gpu.norm.calls and bool(gpu.rendering.calls) == (backend == "auto")
        # the times, which host and draw decide
        assert len(gpu.copies) == (part != "field")
        trained = [p for p in module.parameters() if p.requires_grad]
        assert trained and all(p.grad is not None and p.grad.device == DEVICE for p in trained)
        torch.optim.AdamW(trained, lr=1e-3, fused=True).step()


@BACKENDS
@pytest.mark.parametrize("frozen", [False, True])
def test_a_resident_step_asks_nothing_of_the_host(frozen, backend):
    """Which a CUDA graph could not record."""
    with fake_cuda() as gpu, DEVICE:
        model = made(sizes(backend, preconditioned=True))
        pixels, near = torch.zeros(2, 4, 3, SIDE, SIDE, dtype=torch.uint8), torch.full((2,), 0.8)
        every = cameras(2, 4).to(DEVICE)
        scenes = ResidentScenes(pixels, every.c2w, every.K, near, near + 1)
        field = FrozenField(model, scenes, 2, 2, bf16()) if frozen else None
        if frozen:
            model.encoder.requires_grad_(False)
            model.decoder.requires_grad_(False)
        table = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2]])
        gpu.read = 1e-3  # AdamW looks at its rate, once
        step = Step(model, scenes, table, 2, field, OPTIMIZER, 1.0, 0, bf16())
        gpu.copies.clear()
        gpu.read = None
        for _ in range(2):
            step._step()
        assert not gpu.copies and gpu.norm.calls and bool(gpu.rendering.calls) == (backend == "auto")
        assert all(p.grad.device == DEVICE for p in step.trained)


@BACKENDS
def test_evaluation(backend):
    with fake_cuda() as gpu, torch.no_grad(), bf16():
        model = made(sizes(backend)).eval()
        sampled = CDMSampling("cdm", 2, SamplerSettings(1.0, 0.0, "uniform_lambda", "dpmpp_2m", 0.0), 4)
        for strategy in (SingleImageNeRF("none"), sampled):
            (predicted,) = strategy.predict(model, [views(1)], 0)
            assert bool(gpu.rendering.calls) == (backend == "auto")
            assert predicted.images.device == DEVICE and predicted.images.shape == (2, 3, SIDE, SIDE)


DDIM = SamplerSettings(1.0, 0.0, "uniform_t", "ddim", 0.0)
GUIDANCE = Guidance("snr", 0.3, "current")
TEACHERS = {
    "ngd": lambda own: NGDTeacher(own, 2, replace(DDIM, eta=0.5), GUIDANCE, "current"),
    "direct": lambda own: DirectTeacher(own, 2, 2, DDIM),
    "sds": lambda own: SDSTeacher(own, 2, 0.98, 0.02, "first"),
    "stochastic": lambda own: StochasticTeacher(own, 2, 2, DDIM),
}


@BACKENDS
@pytest.mark.parametrize("coarse", ["every_step", "refresh"])
@pytest.mark.parametrize("teacher", TEACHERS)
def test_guide_and_inner_step(teacher, coarse, backend):
    if coarse == "refresh" and teacher not in ("ngd", "sds"):
        pytest.skip("does not follow the field")
    guide_and_step(TEACHERS[teacher], coarse, backend)


@BACKENDS
@pytest.mark.parametrize("teacher", ["ngd", "direct", "sds, fresh"])
def test_a_step_with_all_parts_asks_nothing_of_the_host(teacher, backend):
    """Patches with a perceptual loss, regularisers, the average of weights, fewer views."""
    fresh = {"sds, fresh": lambda own: SDSTeacher(own, 1, 0.98, 0.02, "first", "sigma2", 1)}
    sharp = Objective(SIDE, "l1", 0.1, 0.01)
    guide_and_step((TEACHERS | fresh)[teacher], "refresh", backend, sharp, average=1.0, views_last=1)


def guide_and_step(teacher, coarse: str, backend: str, objective: Objective | None = None, **more) -> None:
    """One step of the teacher and one inner step, with nothing brought from the host."""
    with fake_cuda() as gpu, bf16():
        model, scene = made(sizes(backend)).eval().requires_grad_(False), views(1, 1)
        encoding = model.encode(scene)
        virtual = VirtualViews(model, encoding, cameras(1, 2).to(DEVICE), 4, (0,), more.get("views_last"))
        field = RefinedField(encoding.triplane, model.decoder)
        fit = FitSettings(1, SIDE**2, 5e-2, 1e-4, "linear", True, 1.0, 10.0, coarse, False, **more)
        module = NGDModule(field, [virtual], [teacher(virtual)], fit, [(0,)], objective)
        module._device = DEVICE
        optimizer = module.configure_optimizers()
        module.optimizers = lambda: SimpleNamespace(optimizer=optimizer)
        module.on_train_start()
        module.on_train_batch_start(0, 0)
        gpu.copies.clear()
        last = module.steps - 1  # where views are dropped, all but one are
        module.training_step(last, last)
        assert field.planes.grad.device == DEVICE and all(p.grad is not None for p in field.parameters())
        assert not gpu.copies and bool(gpu.rendering.calls) == (backend == "auto")
