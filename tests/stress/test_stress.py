"""Each stress does what it says; at the neutral severity nothing happens, to the bit."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hydra.utils import get_method, instantiate
from omegaconf import OmegaConf

from model_fixtures import input_cameras, look_at
from nerfdiff.cameras import Cameras
from nerfdiff.cli import CONF, load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.scene import Scene
from nerfdiff.data.views import EvaluationScenes
from nerfdiff.distill.direct import FixedTeacher
from nerfdiff.distill.distillation import Distillation
from nerfdiff.distill.priors import SRNSpiral
from nerfdiff.stress import cutout, framing, inputs, photo
from nerfdiff.stress.cameras import pose_rotation, pose_shift
from nerfdiff.stress.stress import Stress, stress_of, stressed_readers, with_stress
from nerfdiff.stress.targets import AlienViews, replaced_views
from nerfdiff.stress.training import FaultyReader, white_images, wrong_poses
from nerfdiff.utils.errors import ConfigError, DataError
from procedural.poses import rings

AXES = sorted(path.stem for path in (CONF / "stress").glob("*.yaml") if path.stem != "none")
SIZE = 32


@cache
def composed(command: str, strategy: str | None = None):
    return load_config(command, ["ckpt=demo", f"strategy={strategy}"] if strategy else [])


def config(axis: str, strategy: str = "ngd"):
    """The config of an axis, of the command that it is of: composed once, with the axis's files merged by hand."""
    files = (OmegaConf.load(CONF / name) for name in ("common/stress.yaml", f"stress/{axis}.yaml"))
    stress = OmegaConf.merge(*files)
    del stress["defaults"]
    cfg = composed("train").copy() if axis.startswith("train_") else composed("distill", strategy).copy()
    cfg.stress = stress
    return cfg


def draws() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def disc(radius: float = 9.0) -> torch.Tensor:
    """A coloured disc on white, with a texture."""
    axis = torch.arange(SIZE) + 0.5 - SIZE / 2
    inside = (axis[:, None] ** 2 + axis**2).sqrt() < radius
    colours = torch.stack([0.2 + 0.4 * torch.rand(SIZE, SIZE, generator=draws()) for _ in range(3)])
    return torch.where(inside, colours, 1.0)


def scene() -> ViewBatch:
    """A batch of one, whose targets stand around the object."""
    centres = [(1.3, 0, 1.3), (-1.3, 0.1, 1.3), (0, 0.5, 2.5)]
    source = input_cameras(1, SIZE, SIZE)
    targets = replace(source, c2w=torch.stack([look_at(c) for c in centres])[None], K=source.K[None].expand(1, 3, 3, 3))
    pixels = (disc() * 255).round().byte()[None]
    views = pixels[:, None].expand(1, 3, -1, -1, -1)
    bounds = torch.tensor([0.8]), torch.tensor([1.8])
    return ViewBatch(torch.tensor([0]), pixels, source, views, targets, *bounds, ("a",), ("0",), (("1", "2", "3"),))


@pytest.mark.parametrize("axis", AXES)
def test_an_axis_says_what_it_is_and_acts_on_something(axis):
    cfg = config(axis)
    stress = cfg.stress
    assert stress.axis == axis and stress.source and stress.severities
    assert set(stress.quick) <= set(stress.severities)
    kinds = [stress[name] for name in ("image", "scene", "prior", "targets", "input_view", "training")]
    assert sum(map(bool, [*kinds, stress.settings or stress.factors or stress.at])) == 1
    keys = [*stress.settings, *stress.factors, *(key for at in stress.at.values() for key in at)]
    known = [cfg] if stress.where == "train" else [config(axis), config(axis, "cdm")]
    for key in [*keys, *stress.needs]:
        parent, _, last = key.rpartition(".")
        assert any(last in (OmegaConf.select(each, parent) if parent else each) for each in known), key
    if stress.words or not stress.ordered:
        assert not stress.words or {float(word) for word in stress.words} >= {float(s) for s in stress.severities}


@pytest.mark.parametrize("axis", AXES)
def test_no_severity_and_the_neutral_one_change_nothing(axis):
    cfg = config(axis)
    before = OmegaConf.to_container(cfg, resolve=False)
    for severity in dict.fromkeys([None, cfg.stress.neutral]):
        cfg.stress.severity = severity
        assert stress_of(cfg) is None
        after = OmegaConf.to_container(with_stress(cfg, cfg.stress.where), resolve=False)
        assert after["stress"].pop("severity") == severity
        assert after == before | {"stress": {k: v for k, v in before["stress"].items() if k != "severity"}}


IMAGE_AXES = [
    axis for axis in AXES if not axis.startswith("train_") and "image:" in (CONF / f"stress/{axis}.yaml").read_text()
]


@pytest.mark.parametrize("axis", IMAGE_AXES)
def test_a_stress_of_the_image_changes_the_input_alone_and_more_with_its_severity(axis):
    cfg, batch = config(axis), scene()
    low = [s for s in cfg.stress.severities if s < cfg.stress.neutral]
    for side in filter(None, (low, [s for s in cfg.stress.severities if s not in low])):
        far = []
        for severity in side:
            cfg.stress.severity = severity
            stressed = stress_of(cfg).apply(batch)
            assert torch.equal(stressed.target_pixels, batch.target_pixels)
            assert torch.equal(stressed.source_pixels, stress_of(cfg).apply(batch).source_pixels)  # the same every time
            assert stressed.source_cameras is batch.source_cameras
            far.append(float((stressed.source - batch.source).square().mean()))
        assert all(far) and far[-1] >= max(far) * (0.99 if axis != "low_resolution" else 0.5), far


@pytest.mark.parametrize("pixels", [-4, -2, -1, 1, 2, 4])
def test_masks_grow_and_shrink_by_exactly_as_many_pixels(pixels):
    image = torch.ones(3, 40, 40)
    image[:, 12:26, 10:30] = 0.3
    mask = photo.object_mask(cutout.mask_size(image, pixels, draws(), background=0.4))
    wanted = torch.zeros(40, 40, dtype=torch.bool)
    wanted[12 - pixels : 26 + pixels, 10 - pixels : 30 + pixels] = True
    assert torch.equal(mask, wanted)
    assert torch.equal(cutout.grown(wanted, 0), wanted)


def test_a_hole_of_white_within_the_object_is_the_object():
    image = disc()
    image[:, SIZE // 2, SIZE // 2] = 1.0
    assert photo.object_mask(image)[SIZE // 2, SIZE // 2] and not photo.object_mask(torch.ones(3, 8, 8)).any()


@pytest.mark.parametrize("share", [0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 1.0])
def test_patches_cover_the_share_of_the_object_that_they_are_to(share):
    image = disc()
    covered = photo.occlusion(image, share, draws(), patches=3, grey=0.5)
    mask = photo.object_mask(image)
    changed = (covered != image).any(0)
    assert int(changed.sum()) == round(share * int(mask.sum())) and not changed[~mask].any()
    assert (covered[:, changed] == 0.5).all()


@pytest.mark.parametrize("size", [0.5, 0.7, 1.5])
def test_the_object_has_the_size_that_it_is_to_have(size):
    wide = photo.object_mask(framing.object_size(disc(8.0), size, draws())).any(0).sum()
    assert abs(float(wide) - size * 16) <= 2


@pytest.mark.parametrize("shift", [0.125, 0.25])
def test_the_object_moves_as_far_as_it_is_to(shift):
    image = disc(4.0)
    moved = framing.off_centre(image, shift, draws())
    pixels = round(shift * SIZE)
    assert torch.allclose(moved[:, pixels:, pixels:], image[:, :-pixels, :-pixels], atol=1 / 255)
    assert (moved[:, :pixels] == 1).all()


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_the_frame_cuts_off_the_share_that_it_is_to(share):
    image = torch.ones(3, SIZE, SIZE)
    image[:, 10:20, 8:24] = 0.3
    mask = photo.object_mask(framing.cut_off(image, share, draws()))
    assert int(mask.any(0).sum()) == round((1 - share) * 16) and mask[:, 0].any()
    white = torch.ones(3, SIZE, SIZE)
    assert torch.equal(framing.cut_off(white, share, draws()), white)


def test_shadows_lie_under_the_object_and_halos_around_it():
    image = torch.ones(3, SIZE, SIZE)
    image[:, 10:20, 8:24] = 0.3
    mask = photo.object_mask(image)
    shade = cutout.shadow(image, 0.5, draws(), height=0.35, width=1.2)
    assert shade[0, 20, 16] == pytest.approx(0.5, abs=0.1) and shade[0, :18].equal(image[0, :18])
    halo = cutout.halo(image, 2, draws(), background=0.4)
    changed = (halo < 1).any(0) & ~mask
    assert changed[9, 16] and changed[8, 16] and not changed[7, 16]
    assert halo[0, 9, 16] < halo[0, 8, 16] and halo[:, mask].equal(image[:, mask])
    assert cutout.white_object(image, 0.5, draws())[0, 15, 15] == pytest.approx(0.65)


def test_noise_contrast_and_brightness_are_of_the_object():
    image = disc()
    mask = photo.object_mask(image)
    for changed in (
        photo.noise(image, 0.2, draws()), photo.contrast(image, 0.3, draws()), photo.brightness(image, 0.2, draws()),
    ):  # fmt: skip
        assert (changed[:, ~mask] == 1).all() and not changed[:, mask].equal(image[:, mask])
    flat = torch.where(mask, 0.5, torch.ones(3, SIZE, SIZE))
    spread = (photo.noise(flat, 0.1, draws()) - flat)[:, mask].std()
    assert float(spread) == pytest.approx(0.1, rel=0.15)
    spreads = [float(of[:, mask].std()) for of in (photo.contrast(image, 0.3, draws()), image)]
    assert spreads[0] == pytest.approx(0.3 * spreads[1], rel=0.05)
    assert float(photo.brightness(flat, 0.2, draws())[:, mask].mean()) == pytest.approx(0.7)


def test_a_focal_length_moves_a_point_from_the_centre_as_far_as_it_says():
    batch, cfg = scene(), config("focal")
    assert cfg.stress.severity == 1.2
    point = torch.tensor([[[0.1, -0.2, 1.3]]])
    before, after = batch.source_cameras.project(point)[0], stress_of(cfg).apply(batch).source_cameras.project(point)[0]
    centre = torch.tensor([SIZE / 2, SIZE / 2])
    assert torch.allclose(after - centre, 1.2 * (before - centre), atol=1e-4)
    assert stress_of(cfg).apply(batch).target_cameras is batch.target_cameras  # what is predicted is seen as it is


def test_bounds_are_multiplied():
    cfg = config("near_far")
    cfg.stress.severity = 0.5
    stressed = stress_of(cfg).apply(scene())
    assert (float(stressed.near), float(stressed.far)) == pytest.approx((0.4, 0.9))


@pytest.mark.parametrize("degrees", [1, 20])
def test_virtual_cameras_are_turned_by_the_angle_about_their_centres(degrees):
    cameras = scene().target_cameras
    turned = pose_rotation(cameras, degrees, draws(), 1.3)
    relative = cameras.c2w[..., :3, :3].mT @ turned.c2w[..., :3, :3]
    angles = torch.rad2deg(torch.acos(((relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)))
    assert torch.allclose(angles, torch.full_like(angles, degrees), atol=0.1)
    assert torch.equal(turned.centres, cameras.centres)


def test_virtual_cameras_are_moved_by_the_share_of_their_distance():
    cameras = scene().target_cameras
    moved = pose_shift(cameras, 0.1, draws(), 1.3)
    assert torch.allclose((moved.centres - cameras.centres).norm(dim=-1), torch.tensor(0.13), atol=1e-5)
    assert torch.equal(moved.c2w[..., :3, :3], cameras.c2w[..., :3, :3])


def test_a_prior_is_stressed_the_same_for_every_strategy_and_leaves_others_alone():
    cfg = config("pose_shift")
    cfg.stress.severity = 0.2
    batch, stress = scene(), stress_of(cfg)
    plain = Distillation("x", lambda scene: scene.target_cameras, None, None, 1)
    one, two = (stress.strategy(replace(plain, name=name), list, ["a"]).prior(batch).centres for name in "xy")
    # the radius is that of what all cameras look at
    assert torch.equal(one, two) and (one - batch.target_cameras.centres).norm(dim=-1).min() > 0.2
    none = instantiate({"_target_": "nerfdiff.distill.none.SingleImageNeRF", "name": "none"})
    assert stress.strategy(none, list, ["a"]) is none


@pytest.mark.parametrize(
    ("views", "share", "replaced"), [(10, 0.1, [5]), (10, 0.3, [1, 5, 8]), (8, 0.03, [4]), (2, 1.0, [0, 1])]
)
def test_alien_views_take_the_places_of_some_targets(views, share, replaced):
    assert replaced_views(views, share) == replaced
    own, alien = torch.zeros(views, 3, 4, 4), torch.ones(2, 3, 4, 4)
    teacher = AlienViews(FixedTeacher(own, steps=3), share, alien)
    assert (teacher.steps, teacher.t, teacher.follows_field) == (3, None, False)
    targets = teacher.targets(0, None)
    assert [view for view in range(views) if targets[view].any()] == replaced and not own.any()
    teacher.teacher.targets = lambda step, rendered: None  # the renderings are the targets, but for the alien views
    targets = teacher.targets(0, torch.full_like(own, 0.5))
    assert [view for view in range(views) if targets[view].eq(1).all()] == replaced


def test_alien_views_are_of_the_scene_before_and_need_one():
    stress = Stress("alien_views", 0.5, 0, targets=True)
    plain = Distillation("x", None, lambda views: FixedTeacher(torch.zeros(2, 3, 4, 4), 1), None, 1)
    with pytest.raises(ConfigError, match="two scenes"):
        stress.strategy(plain, list, ["a"])
    asked = []

    def load(names):
        asked.extend(names)
        return [scene()]

    made = stress.strategy(plain, load, ["a", "b"]).teacher(type("Views", (), {"seed": (0, "distil", "b")}))
    assert asked == ["a"] and made.alien.equal(scene().targets[0])


def ring() -> Cameras:
    """Around the origin, z up: elevations 0, 30 and 60 at azimuths of 0, 90, 180 and 270 degrees."""
    centres = []
    for elevation in (0, 30, 60):
        for azimuth in (0, 90, 180, 270):
            e, a = math.radians(elevation), math.radians(azimuth)
            centres.append((math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)))
    c2w = torch.stack([look_at(c, target=(0, 0, 0), down=(0, 0, -1)) for c in centres])
    return Cameras(c2w, torch.eye(3).expand(12, 3, 3), 4, 4)


@pytest.mark.parametrize(("wanted", "own", "view"), [(30, 1, 5), (60, 6, 10), (0, 0, 0), (28, 3, 7), (-10, 0, None)])
def test_the_input_view_is_of_the_elevation_and_turned_least(wanted, own, view):
    assert inputs.elevation(ring(), own, wanted, tolerance=5.0) == view


def test_the_input_view_is_of_the_direction():
    towards = [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    assert [inputs.direction(ring(), 0, s, 20.0, towards) for s in (1, 2, 3)] == [1, 3, None]


class Reader:
    """Four scenes of three views, of a grey level each."""

    identity, nearest_view = "four", False

    def __len__(self):
        return 4

    def scene_id(self, index):
        return f"s{index}"

    def view_names(self, index):
        return "0", "1", "2"

    def listing(self, index):
        from nerfdiff.data.scene import Listing

        return Listing(ring().c2w[:3].numpy(), {})

    def fingerprint(self):
        return "f"

    def load(self, index, views=None, truth=False):
        views = [0, 1, 2] if views is None else list(views)
        pixels = torch.full((3, 3, 4, 4), 10 * index, dtype=torch.uint8) + torch.arange(3).byte()[:, None, None, None]
        return Scene(f"s{index}", tuple(str(v) for v in views), pixels[views], ring()[views], 0.5, 1.5)


def test_scenes_without_such_an_input_view_are_told():
    cfg = config("elevation")
    cfg.stress.severity = 0
    scenes = EvaluationScenes(Reader(), 1)
    stress_of(cfg).inputs(scenes)
    assert scenes.sources == [1] * 4
    cfg.stress.severity = -10
    with pytest.raises(DataError, match=r"no view of scene s0 .*docs/stability\.md"):
        stress_of(cfg).inputs(scenes)


@pytest.mark.parametrize("fault", [wrong_poses, white_images, None])
def test_a_share_of_the_training_scenes_is_faulty(fault):
    reader = FaultyReader(Reader(), 0.5, fault, seed=0)
    assert len(reader.faulty) == 2 and len(reader) == 4 and reader.identity != Reader.identity
    for index in range(4):
        found, sound = reader.load(index), Reader().load(index)
        part = reader.load(index, [2, 0])
        assert part.pixels.equal(found.pixels[[2, 0]]) and part.cameras.c2w.equal(found.cameras.c2w[[2, 0]])
        assert part.views == ("2", "0")
        same = found.pixels.equal(sound.pixels), found.cameras.c2w.equal(sound.cameras.c2w)
        expected = {wrong_poses: (True, False), white_images: (False, True), None: (False, True)}[fault]
        assert same == (expected if index in reader.faulty else (True, True))
        if fault is wrong_poses and index in reader.faulty:
            assert not any(a.equal(b) for a, b in zip(found.cameras.c2w, sound.cameras.c2w, strict=True))


@pytest.mark.parametrize("axis", ["train_wrong_poses", "train_swapped_images", "train_white_images"])
def test_only_the_training_split_is_faulty(axis):
    cfg = config(axis)
    make = stressed_readers(lambda **settings: Reader(), stress_of(cfg), "train")
    assert len(make(split="train").faulty) == 1 and isinstance(make(split="val"), Reader)


@pytest.mark.parametrize(
    ("axis", "severity", "strategy", "changed"),
    [
        ("views", 5, "ngd", {"budget.views": 5, "strategy.prior.views": 5}),
        ("rays", 16, "direct", {"strategy.rays": 16}),
        ("inner_steps", 0, "sds", {"strategy.inner_steps": 0}),
        ("diffusion_steps", 1, "ngd", {"strategy.teacher.steps": 1}),
        ("lr_planes", 10.0, "ngd", {"strategy.lr_planes": 0.5}),
        ("lr_decoder", 0.1, "ngd", {"strategy.lr_decoder": 1e-5}),
        ("guidance_weight", 0.25, "ngd_current", {"strategy.teacher.guidance.schedule": "constant"}),
        ("guidance_gamma", 100.0, "ngd", {"strategy.teacher.guidance.gamma": 100.0}),
        ("precision", 3, "none", {"precision": "16-mixed"}),
        ("seed", 7, "ngd", {"seed": 7}),
        ("shape", 2, "none", {"data.reader.near": 1.25, "data.root": "data/procedural/chairs_64"}),
        ("prior_training", 0.25, "ngd", {"ckpt": "None/model_0.25"}),
        ("lr_planes", 10.0, "none", {}),
        ("guidance_weight", 0.25, "direct", {}),
    ],
)  # fmt: skip
def test_settings_are_those_of_the_severity(axis, severity, strategy, changed, caplog):
    cfg = config(axis, strategy)
    cfg.stress.severity = severity
    stressed = with_stress(cfg, "distill")
    assert {key: OmegaConf.select(stressed, key) for key in changed} == changed
    assert ("does not act" in caplog.text) == (not changed)
    stress = stress_of(stressed)
    assert (stress.axis, stress.severity, stress.identity) == (axis, severity, {})


def test_a_severity_that_an_axis_does_not_have_and_an_axis_of_another_command_are_refused():
    cfg = config("precision")
    cfg.stress.severity = 9
    with pytest.raises(ConfigError, match=r"stress\.severity=9: stress=precision has 1, 2, 3"):
        with_stress(cfg, "distill")
    with pytest.raises(ConfigError, match=r"of train\.py"):
        with_stress(config("train_lr"), "distill")
    cfg = config("views")
    cfg.stress.severity = 0
    with pytest.raises(ConfigError, match=r"budget\.views=0"):
        with_stress(cfg, "distill")


def test_the_faults_of_training_are_functions_that_there_are():
    for name in ("wrong_poses", "white_images"):
        assert get_method(f"nerfdiff.stress.training.{name}") in (wrong_poses, white_images)


def test_a_prior_of_numbered_views_is_told_which_of_them_the_input_is():
    """Views relative to the input view are those of SRN's spiral relative to the view that was chosen."""
    plain = Distillation("x", SRNSpiral(4, source_view=64, radius=1.3, min_cosine=0.9), None, None, 1)
    stressed = Stress("elevation", 50, 0, input_view=inputs.elevation).strategy(plain, list, ["a"])
    batch = replace(scene(), source_views=("000120",))
    wanted = SRNSpiral(4, source_view=120, radius=1.3, min_cosine=0.9)(batch)
    assert torch.equal(stressed.prior(batch).c2w, wanted.c2w)


def test_generated_rings_have_the_elevations_that_they_are_to():
    c2w = rings(2.0, 8, (-10, 50))
    assert np.allclose(np.linalg.norm(c2w[:, :3, 3], axis=1), 2.0)
    found = np.degrees(np.arcsin(c2w[:, 2, 3] / 2))
    assert np.allclose(found, [-10, 50] * 4) and len({tuple(pose.round(6).ravel()) for pose in c2w}) == 8
