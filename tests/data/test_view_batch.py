"""Samples of one scene, and batches of them, against the scene they come from."""

import pytest
import torch

import posed_fixtures
from data_fixtures import FAR, NEAR, write_srn
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.draws import Draws
from nerfdiff.data.readers.posed_images import PosedImagesReader
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.views import EvaluationScenes, TrainingViews, spread
from nerfdiff.utils.errors import DataError


@pytest.fixture
def reader(tmp_path) -> SRNReader:
    write_srn(tmp_path, truth=True)
    return SRNReader(tmp_path, "cars", "train", NEAR, FAR)


def test_a_sample_is_its_scene_in_the_source_camera(reader):
    scene = reader.load(1, truth=True)
    batch = ViewBatch.collate([Sample(scene, source=3, targets=[0, 3], draw=17)])
    assert len(batch) == 1 and batch.draws.tolist() == [17]
    assert torch.equal(batch.source[0], scene.images[3])
    assert torch.equal(batch.targets[0], scene.images[[0, 3]])
    assert torch.equal(batch.target_depth[0], scene.depth[[0, 3]])
    assert torch.equal(batch.target_mask[0], scene.mask[[0, 3]])
    assert batch.scene_ids == ("scene1",)
    assert batch.source_views == ("000003",) and batch.target_views == (("000000", "000003"),)
    assert (batch.near.tolist(), batch.far.tolist()) == ([pytest.approx(NEAR)], [pytest.approx(FAR)])
    assert torch.equal(batch.source_cameras.c2w, torch.eye(4)[None])
    c2w = scene.cameras.c2w.double()
    expected = torch.linalg.inv(c2w[3]) @ c2w[[0, 3]]
    assert (batch.target_cameras.c2w[0] - expected).abs().max() < 1e-6
    assert torch.equal(batch.source_cameras.K, scene.cameras.K[3:4])
    assert batch.target_cameras.K.shape == (1, 2, 3, 3)


def test_collating_joins_samples_in_order(reader):
    samples = [Sample(reader.load(k), k, [0, 4], draw=10 + k) for k in range(3)]
    batch = ViewBatch.collate(samples)
    assert len(batch) == 3 and batch.draws.tolist() == [10, 11, 12]
    assert batch.scene_ids == ("scene0", "scene1", "scene2")
    assert batch.source_views == ("000000", "000001", "000002")
    assert batch.target_views == (("000000", "000004"),) * 3
    assert batch.source.shape == (3, 3, 40, 56) and batch.targets.shape == (3, 2, 3, 40, 56)
    assert batch.source_cameras.shape == (3,) and batch.target_cameras.shape == (3, 2)
    assert batch.target_depth is None
    for k, sample in enumerate(samples):
        alone = ViewBatch.collate([sample])
        assert torch.equal(batch.source_pixels[k], alone.source_pixels[0])
        assert torch.equal(batch.target_pixels[k], alone.target_pixels[0])
        assert torch.equal(batch.target_cameras.c2w[k], alone.target_cameras.c2w[0])
        assert torch.equal(batch.source_cameras.K[k], alone.source_cameras.K[0])


def test_batches_of_several_image_sizes_are_refused(reader):
    small = SRNReader(reader.folder.parent, "cars", "train", NEAR, FAR, image_size=[20, 28])
    with pytest.raises(DataError, match=r"one size.*\(20, 28\), \(40, 56\).*data\.image_size"):
        ViewBatch.collate([Sample(reader.load(0), 0, [1], 0), Sample(small.load(1), 0, [1], 1)])


def test_moving_takes_every_tensor_and_nothing_else(reader):
    batch = ViewBatch.collate([Sample(reader.load(0, truth=True), 0, [1, 2], draw=4)])
    moved = batch.to("meta")
    assert moved.draws.device.type == "cpu"  # they seed what the host draws
    tensors = [moved.source, moved.targets, moved.near, moved.far, moved.target_depth, moved.target_mask]
    for camera in (moved.source_cameras, moved.target_cameras):
        tensors += [camera.c2w, camera.K]
    assert all(tensor.device.type == "meta" for tensor in tensors)
    assert moved.scene_ids == batch.scene_ids and moved.target_cameras.height == 40
    assert batch.draws.device.type == "cpu"


def test_training_items_are_the_draws(reader):
    draws = Draws(seed=1, scenes=3, target_views=2, source_as_target=0.5)
    dataset = TrainingViews(reader, draws)
    sources_as_targets = 0
    for n in range(20):
        item = ViewBatch.collate([dataset[n]])
        index = draws.scene(n)
        source, targets = draws.views(n, 5)
        scene = reader.load(index)
        assert item.draws.tolist() == [n] and item.scene_ids == (scene.id,)
        assert torch.equal(item.source[0], scene.images[source])
        assert torch.equal(item.targets[0], scene.images[list(targets)])
        if targets[0] == source:
            sources_as_targets += 1
            assert (item.target_cameras.c2w[0, 0] - torch.eye(4)).abs().max() < 1e-6
    assert 0 < sources_as_targets < 20


def test_too_few_views_to_train_on(reader):
    dataset = TrainingViews(reader, Draws(seed=1, scenes=3, target_views=5, source_as_target=0.0))
    with pytest.raises(DataError, match=r"scene\d has 5 views; .*data.target_views=5 targets need 6"):
        dataset[0]


def test_evaluation_takes_the_source_by_its_number(tmp_path):
    write_srn(tmp_path, {"test": 2}, views=[10, 64, 65, 70, 99], truth=True)
    dataset = EvaluationScenes(SRNReader(tmp_path, "cars", "test", NEAR, FAR), source_view=64)
    assert len(dataset) == 2
    item = ViewBatch.collate([dataset[1]])
    assert item.scene_ids == ("scene1",) and item.draws.tolist() == [1]
    assert item.source_views == ("000064",)
    assert item.target_views == (("000010", "000065", "000070", "000099"),)
    assert item.target_depth.shape == item.target_mask.shape == (1, 4, 40, 56)
    with pytest.raises(DataError, match=r"scene0 has no view 7, but 5 views 000010 to 000099; set data\.source_view"):
        EvaluationScenes(SRNReader(tmp_path, "cars", "test", NEAR, FAR), source_view=7)


@pytest.fixture
def own_scenes(tmp_path) -> PosedImagesReader:
    """Scenes of frames 0 to 3, 3 to 6 and 8 to 11, and one whose frames are not named by numbers."""
    for name, start in (("a", 0), ("b", 3), ("c", 8), ("d", None)):
        folder = tmp_path / "train" / name
        posed_fixtures.write_nerfstudio(folder, views=4, masks=False)
        if start is not None:
            text = (folder / "transforms.json").read_text()
            for k in range(4):
                (folder / f"images/frame_{k + 1:05d}.png").rename(folder / f"images/{start + k:04d}.png")
                text = text.replace(f"frame_{k + 1:05d}.png", f"{start + k:04d}.png")
            (folder / "transforms.json").write_text(text)
    return PosedImagesReader(tmp_path, "train", **posed_fixtures.SETTINGS)


@pytest.mark.parametrize(
    ("view", "taken", "others"),
    [
        (0, ("0000", "0003", "0008", "frame_00001"), 2),
        (3, ("0003", "0003", "0008", "frame_00004"), 1),
        (5, ("0003", "0005", "0008", "frame_00004"), 3),
        (7, ("0003", "0006", "0008", "frame_00004"), 4),
        (99, ("0003", "0006", "0011", "frame_00004"), 4),
    ],
)
def test_own_scenes_that_lack_a_frame_take_the_nearest_with_one_warning(
    own_scenes, tmp_path, view, taken, others, caplog
):
    for reader in (own_scenes, CachedReader(own_scenes, tmp_path / "cache", "own")):
        caplog.clear()
        dataset = EvaluationScenes(reader, source_view=view)
        assert tuple(ViewBatch.collate([dataset[k]]).source_views[0] for k in range(4)) == taken
        (said,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
        assert f"{others} of 4 scenes have no view {view}" in said and f"c ({taken[2]})" in said
    training = TrainingViews(
        own_scenes, Draws(seed=1, scenes=4, target_views=1, source_as_target=0.0), source_view=view
    )
    for draw in range(4):
        sample = training[draw]
        assert sample.scene.views[sample.source] == taken["abcd".index(sample.scene.id)]


def test_a_frame_that_all_have_is_taken_without_a_word(own_scenes, caplog):
    caplog.clear()
    dataset = EvaluationScenes(own_scenes, source_view=8, scenes=1)
    assert [own_scenes.scene_id(k) for k in dataset.indices] == ["c"] and not caplog.records


def test_evaluation_takes_the_source_by_position_where_names_are_words(tmp_path):
    write_srn(tmp_path, {"test": 1}, views=3)
    for kind, suffix in (("rgb", "png"), ("pose", "txt")):
        (tmp_path / f"cars_test/scene0/{kind}/000001.{suffix}").rename(
            tmp_path / f"cars_test/scene0/{kind}/front.{suffix}"
        )
    dataset = EvaluationScenes(SRNReader(tmp_path, "cars", "test", NEAR, FAR), source_view=2)
    item = ViewBatch.collate([dataset[0]])
    assert item.source_views == ("front",) and item.target_views == (("000000", "000002"),)


def test_evaluation_of_part_of_a_split(tmp_path):
    write_srn(tmp_path, {"test": 5}, views=11)
    reader = SRNReader(tmp_path, "cars", "test", NEAR, FAR)
    few = EvaluationScenes(reader, source_view=4, scenes=2, targets=3)
    assert [few[k].scene.id for k in range(2)] == ["scene1", "scene3"]
    assert ViewBatch.collate([few[0]]).target_views == (("000001", "000006", "000009"),)
    strided = EvaluationScenes(reader, source_view=4, stride=3)[0]
    assert ViewBatch.collate([strided]).target_views == (("000000", "000003", "000007", "000010"),)


def test_a_scene_of_one_view_cannot_be_evaluated(tmp_path):
    write_srn(tmp_path, {"test": 1}, views=1)
    dataset = EvaluationScenes(SRNReader(tmp_path, "cars", "test", NEAR, FAR), source_view=0)
    with pytest.raises(DataError, match="scene0 has no view beside its source 000000"):
        dataset[0]


@pytest.mark.parametrize(
    ("count", "wanted", "expected"),
    [(5, None, [0, 1, 2, 3, 4]), (3, 8, [0, 1, 2]), (10, 1, [5]), (10, 2, [2, 7]), (250, 4, [31, 93, 156, 218])],
)
def test_spread(count, wanted, expected):
    assert spread(count, wanted) == expected


def test_only_targets_that_are_their_source_are_shifted(reader):
    scene = reader.load(0)
    shift = (0.1, -0.2, 0.3)
    plain, moved = (ViewBatch.collate([Sample(scene, 1, [1, 0, 2], 0, s)]) for s in (None, shift))
    change = moved.target_cameras.c2w - plain.target_cameras.c2w
    expected = torch.zeros_like(change)
    expected[0, 0, :3, 3] = torch.tensor(shift)
    assert torch.equal(change, expected)
    assert torch.equal(moved.source_cameras.c2w, plain.source_cameras.c2w)
