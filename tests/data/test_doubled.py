"""Photographs that are also read at twice the size, for the means over their pixels between them."""

from dataclasses import replace
from pathlib import Path

import pytest
import scenes_on_disk as disk
import textured_wall as wall
import torch
from matched_sizes import matched_sizes
from networks import SMALL
from torch.nn import functional as F

from tidefield.config import SWIFT, Sampling
from tidefield.data.areas import select
from tidefield.data.batches import draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.exposure import to_common_exposure
from tidefield.data.load import at_twice_the_size, load_scene
from tidefield.data.pyramid import PER_OCTAVE, Pyramid
from tidefield.data.scene import Scene
from tidefield.model.network import make_network
from tidefield.model.renderer import Renderer
from tidefield.synthetic import Flight, make_survey, write_survey
from tidefield.train.loop import SceneTrainer
from tidefield.train.pretrain import Pretrainer
from tidefield.train.stream import Draw, Stream

CPU = torch.device("cpu")
WIDTH = 32
"""Half of what the files have."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("survey")
    disk.write_colmap(root, disk.survey(disk.BARREL))
    return root


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    found = load_scene(folder, width=WIDTH)
    gain = torch.linspace(0.7, 1.4, 27).reshape(9, 3)
    shading = 0.1 * torch.randn(9, 15, 3, generator=torch.Generator().manual_seed(0))
    assert found.cameras.shading is None or found.cameras.shading.shape == shading.shape
    return replace(found, cameras=replace(found.cameras, gain=gain, shading=shading))


def test_a_scene_at_twice_the_size_is_that_of_its_files(scene: Scene, folder: Path):
    doubled, whole = at_twice_the_size(scene), load_scene(folder)
    assert doubled is not None
    assert doubled.names == scene.names
    assert torch.equal(doubled.cameras.size_px, 2 * scene.cameras.size_px)
    torch.testing.assert_close(doubled.cameras.focal_px, whole.cameras.focal_px)
    assert all(torch.equal(doubled.photographs[i], whole.photographs[i]) for i in range(9))


def test_without_enough_pixels_or_memory_nothing_is_doubled(
    scene: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    assert at_twice_the_size(load_scene(folder, width=WIDTH + 1)) is None
    assert at_twice_the_size(wall.scene(wall.cameras(3))) is None
    monkeypatch.setattr("tidefield.data.load.DOUBLED_BYTES", 9 * 64 * 48 * 3 - 1)
    assert at_twice_the_size(scene) is None


def test_levels_from_the_scenes_own_size_on_are_doubled_as_far_as_files_go(scene: Scene):
    pyramid, doubled = Pyramid(scene), at_twice_the_size(scene)
    assert doubled is not None
    found = pyramid.read_doubled(4, 0)
    assert found is not None
    assert torch.equal(found, doubled.photographs[4])
    assert pyramid.read_doubled(4, 1) is None
    assert pyramid.read_doubled(4, -PER_OCTAVE) is None
    assert Pyramid(wall.scene(wall.cameras(3))).read_doubled(0, 0) is None
    assert torch.equal(pyramid.read(4, 0)[0], scene.photographs[4])


def test_crops_at_twice_the_size_show_what_the_crops_show(scene: Scene):
    doubled = at_twice_the_size(scene)
    assert doubled is not None
    config = replace(SWIFT.train, tile_px=8, tiles=6, crop_px=16)
    batch = draw_batch(scene, DepthPriors(scene), config, 3, torch.Generator().manual_seed(0), doubled=doubled)
    crops, larger = batch.colours_of_images(0), batch.colours_at_twice_the_size(0)
    assert larger is not None
    assert larger.shape == (*crops.shape[:2], 32, 32)
    torch.testing.assert_close(F.avg_pool2d(larger, 2), crops, atol=0.02, rtol=0)
    neighbour, (u, v) = int(batch.neighbours[2, 1]), batch.image_corner_px[0][2 * batch.neighbours.shape[1] + 1]
    part = to_common_exposure(doubled, neighbour)[2 * v : 2 * v + 32, 2 * u : 2 * u + 32]
    torch.testing.assert_close(larger[2 * batch.neighbours.shape[1] + 1], part.permute(2, 0, 1))
    both = [part for half in batch.parts(2) for part in half.image_doubled]
    assert torch.equal(torch.cat(both), batch.image_doubled[0])


def test_an_area_has_the_same_photographs_at_twice_the_size(scene: Scene):
    area = select(scene, scene.train[:2], at_twice_the_size(scene))
    assert area.doubled is not None
    assert area.doubled.names == area.scene.names
    assert torch.equal(area.doubled.cameras.size_px, 2 * area.scene.cameras.size_px)


@pytest.mark.thorough
def test_training_reads_what_it_is_prepared_with(scene: Scene):
    config = replace(SWIFT, train=replace(SWIFT.train, tile_px=8, tiles=2, crop_px=16))
    losses = []
    for prepared in (True, False):
        trainer = SceneTrainer(config, scene, 0, CPU)
        if prepared:
            trainer.prepare()
        opened = trainer.open_area().area
        assert opened.doubled is not None
        losses.append(trainer.loss(trainer.draw())[1].item())
    without = SceneTrainer(config, replace(scene, photographs=replace(scene.photographs, files=())), 0, CPU)
    assert without.open_area().area.doubled is None
    assert losses[0] == losses[1] != without.loss(without.draw())[1].item()


def test_training_matches_at_twice_the_size_as_views_do(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    sizes = matched_sizes(monkeypatch)
    trainer = SceneTrainer(SMALL, scene, 0, CPU)
    assert trainer.open_area().priors[scene.train[0]].detail is not None
    torch.manual_seed(0)
    Renderer(make_network(SMALL.network).eval(), scene, SMALL, CPU)(scene.cameras[scene.train[0]])
    assert [width for width, _ in sizes] == [2 * WIDTH, 2 * WIDTH]


def test_training_across_scenes_matches_and_reads_photographs_as_training_on_one_does(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    sizes, twice, own = matched_sizes(monkeypatch), at_twice_the_size(scene), []
    assert twice is not None
    with Stream(tmp_path / "scenes", [], 1, SMALL) as scenes:
        for channels in ((0, 1, 2), (2, 0, 1)):
            drawn = scenes._augmented(scene, Draw(None, 0.0, 1.0, 0.0, 0.0, channels, 7))
            assert drawn.doubled is not None
            assert torch.equal(drawn.doubled.photographs[2], twice.photographs[2][..., channels])
            assert torch.equal(drawn.scene.photographs[2], scene.photographs[2][..., channels])
            own.append(drawn.priors[scene.train[0]])
            monkeypatch.setattr(scenes, "draw", lambda *_, drawn=drawn: drawn)
            assert Pretrainer(SMALL, scenes, scene, 0, CPU).draw().batch.image_doubled
    assert [width for width, _ in sizes] == [2 * WIDTH] * len(sizes)
    assert torch.equal(own[0].cells, own[1].cells)
    assert own[0].detail is not None
    assert own[1].detail is not None
    assert torch.equal(own[0].detail, own[1].detail)


@pytest.mark.thorough
def test_a_view_comes_closer_to_the_photograph_that_was_not_used(tmp_path: Path):
    flight = Flight(focal_ratio=1.6)
    survey = make_survey("ground_textures", seed=3, views=9, width=128, flight=flight, supersample=1)
    write_survey(survey, tmp_path, truth=False)
    scene = load_scene(tmp_path, width=64)
    torch.manual_seed(0)
    network = make_network(SWIFT.network).eval()
    truth = scene.photographs[scene.test[0]].float() / 255
    errors = [
        (Renderer(network, scene, SWIFT, CPU, Sampling(cones, 1))(scene.cameras[scene.test[0]]).colour - truth)
        .square()
        .mean()
        for cones in (True, False)
    ]
    assert errors[0] < 0.95 * errors[1]
