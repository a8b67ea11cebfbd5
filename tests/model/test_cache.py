"""Features kept in blocks: every tile finds what it shows, whatever is forgotten meanwhile."""

import threading
from dataclasses import replace

import pytest
import textured_wall as wall
import torch
from torch import Tensor

from tidefield.config import PRESETS, SWIFT
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours
from tidefield.geometry.cameras import Cameras
from tidefield.model import cache as feature_cache
from tidefield.model.cache import (
    FREE_SHARE,
    LEAST_BYTES,
    MEMORY_SHARE,
    Block,
    BlockRead,
    CacheFull,
    FeatureCache,
    memory_for_features,
    padded_channels,
)
from tidefield.model.network import Network, make_network
from tidefield.model.renderer import Renderer
from tidefield.model.views import Views
from tidefield.parallel import read_ahead

CPU = torch.device("cpu")
TARGET = 3
UNMATCHED = replace(SWIFT, network=replace(SWIFT.network, without=(*SWIFT.network.without, "matched surface")))
"""Searching for the surface would take most of the time."""


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_cache, "BLOCK_PX", 64)
    monkeypatch.setattr(feature_cache, "WHOLE_PX", 64)
    monkeypatch.setattr(feature_cache, "OVERLAP_PX", 32)


@pytest.fixture(scope="module")
def network() -> Network:
    torch.manual_seed(0)
    return make_network(SWIFT.network).eval()


def scene():
    return wall.scene(wall.cameras(7, 160, 96, step=0.25), (TARGET,))


@pytest.mark.usefixtures("small_blocks")
@torch.inference_mode()
def test_what_a_tile_shows_is_read_from_a_block_that_holds_it(network: Network):
    at = scene()
    seen_uv = torch.tensor([[20.0, 15.0], [60.0, 40.0], [81.0, 48.0], [150.0, 90.0]])
    view = at.cameras[1]
    middle = view.position_world + 5 * view.directions_world(seen_uv[None])[0]
    neighbours = torch.full((len(seen_uv), 1), 1)
    views = FeatureCache(network, at, CPU).views(view, Neighbours(neighbours, torch.ones(4, 1, 4)), middle)
    # Eight pixels around each middle, seen along rays of the view itself.
    around = seen_uv[:, None] + torch.tensor([[-8.0, -3.0], [0.0, 0.0], [7.0, 5.0]])
    directions = view.directions_world(around.reshape(1, -1, 2)).reshape(len(seen_uv), 3, 3)
    found = views.read(
        1, view.position_world[None] + 5 * directions, directions, torch.full((4, 3, 2), 0.5), torch.ones(4, 3)
    )
    assert found.valid.all()
    assert len(views.which.unique()) == 4
    column, row = around.reshape(-1, 2).long().unbind(-1)
    truth = at.photographs[1][row.clamp(max=95), column.clamp(max=159)].float() / 255
    # Bilinear between pixels against the nearest pixel of a smooth wall.
    assert (found.colours.reshape(-1, 3) - truth).abs().mean() < 0.08


@pytest.mark.usefixtures("small_blocks")
@torch.inference_mode()
def test_ground_next_to_what_stands_on_it_is_read_from_the_block_that_holds_both(network: Network):
    """Blocks of 64 pixels begin every 32: the one around pixel 79 ends at 96."""
    at = scene()
    view, neighbours = at.cameras[1], Neighbours(torch.full((1, 1), 1), torch.ones(1, 1, 4))

    def shown(*columns: float) -> Tensor:
        uv = torch.tensor([[[u, 40.0] for u in columns]])
        return view.position_world + 5 * view.directions_world(uv)[0]

    def valid(cache: FeatureCache, ends: Tensor | None, *columns: float) -> list[bool]:
        views = cache.views(view, neighbours, shown(79.0), ends)
        points = shown(*columns)[None]
        directions = points - view.position_world
        count = len(columns)
        found = views.read(1, points, directions, torch.full((1, count, 2), 0.5), torch.ones(1, count))
        return found.valid.flatten().tolist()

    cache = FeatureCache(network, at, CPU)
    assert valid(cache, None, 74.0, 84.0, 104.0) == [True, True, False]
    assert valid(cache, shown(79.0, 104.0)[None], 74.0, 84.0, 104.0) == [True, True, True]
    assert valid(cache, shown(79.0, 1000.0)[None], 74.0, 84.0) == [True, True], "the middle is always in it"
    alone = FeatureCache(network, at, CPU)
    for ends in (None, shown(79.0, 88.0)[None], shown(45.0, 70.0)[None]):
        alone.views(view, neighbours, shown(79.0), ends)
    assert len(alone._slots) == 1, "one that holds all is not left"


def test_a_tile_reaches_from_its_nearest_to_its_farthest_surface(network: Network, monkeypatch: pytest.MonkeyPatch):
    at = scene()
    view, given = at.cameras[TARGET], []

    def noted(cache: FeatureCache, camera: Cameras, neighbours: Neighbours, middle: Tensor, ends: Tensor) -> Views:
        given.append((middle, ends))
        return views(cache, camera, neighbours, middle, ends)

    views = FeatureCache.views
    monkeypatch.setattr(FeatureCache, "views", noted)
    prior = torch.tensor([1 / 5, 1 / 4, 1 / 6])[:, None, None].repeat(1, 24, 40)
    prior[0, 2, 9] = 1 / 4.5  # a cell of the second tile
    prior[0, 20:, 32:] = torch.nan
    Renderer(network, at, UNMATCHED, CPU)(view, prior)
    [(middle, ends)] = given
    (uv, z), (at_middle, _) = view.project(ends.flatten(0, 1)), view.project(middle)
    torch.testing.assert_close(uv.reshape(15, 2, 2), at_middle.reshape(15, 1, 2).expand(-1, 2, -1), atol=1e-3, rtol=0)
    depth = torch.full((15, 2), 5.0)
    depth[1, 0], depth[14, 0] = 4.5, 24 / 5
    torch.testing.assert_close(z.reshape(15, 2), depth)


@pytest.mark.thorough
@pytest.mark.usefixtures("small_blocks")
def test_evicted_blocks_are_encoded_again_alike(network: Network):
    at = scene()
    roomy, cramped = (Renderer(network, at, UNMATCHED, CPU) for _ in range(2))
    cramped.cache = FeatureCache(network, at, CPU, budget_bytes=1)
    assert cramped.cache.slots == SWIFT.network.views + EXTRA_VIEWS < roomy.cache.slots
    one, other = (renderer(at.cameras[TARGET]) for renderer in (roomy, cramped))
    torch.testing.assert_close(one.colour, other.colour, atol=1e-4, rtol=0)


@pytest.mark.usefixtures("small_blocks")
def test_photographs_that_are_not_large_are_encoded_whole(network: Network, monkeypatch: pytest.MonkeyPatch):
    at = scene()
    found = []
    for whole in (160, 159):
        monkeypatch.setattr(feature_cache, "WHOLE_PX", whole)
        renderer = Renderer(network, at, UNMATCHED, CPU)
        found.append((renderer(at.cameras[TARGET]).colour, {block[2:] for block in renderer.cache._slots}))
    (colour, blocks), (in_blocks, several) = found
    assert blocks == {(0, 0)}
    assert len(several) > 1
    torch.testing.assert_close(colour, in_blocks, atol=0.02, rtol=0)


@pytest.mark.usefixtures("small_blocks")
@torch.inference_mode()
def test_networks_with_instance_norms_encode_whole_photographs_as_in_training():
    torch.manual_seed(0)
    paper, at = make_network(PRESETS["paper"].network).eval(), scene()
    cache = FeatureCache(paper, at, CPU, cones=False)
    view = at.cameras[1]
    middle = view.position_world + 5 * view.directions_world(torch.tensor([[[20.0, 15.0]]]))[0]
    views = cache.views(view, Neighbours(torch.full((1, 1), 1), torch.ones(1, 1, 4)), middle)
    colours = at.photographs[1].permute(2, 0, 1)[None] / 255 / view.gain_at(torch.zeros(1, 1, 2))[0, 0, :, None, None]
    whole = paper.encode(colours)
    assert {block[2:] for block in cache._slots} == {(0, 0)}
    for stride, maps in whole.features.items():
        found = views.encoded.features[stride]
        first = int(found.first[views.which[0, 0]])
        rows = found.rows[first : first + len(maps.rows), : maps.channels]
        torch.testing.assert_close(rows.float(), maps.rows.float(), atol=0.01, rtol=0.01)


@pytest.mark.usefixtures("small_blocks")
def test_more_blocks_than_slots_are_refused(network: Network):
    cramped = FeatureCache(network, scene(), CPU, budget_bytes=1)
    neighbours = torch.tensor([[0, 1, 2, 4, 5], [6, 1, 2, 4, 3]])
    with pytest.raises(CacheFull):
        cramped.views(scene().cameras[TARGET], Neighbours(neighbours, torch.ones(2, 5, 4)), torch.zeros(2, 3))


@pytest.mark.usefixtures("small_blocks")
@torch.inference_mode()
def test_masked_pixels_are_no_valid_samples(network: Network):
    at = wall.with_left_halves_masked(scene(), (1,))
    seen_uv = torch.tensor([[60.0, 40.0], [75.0, 15.0], [85.0, 48.0], [150.0, 90.0]])
    for index, expected in ((1, [False, False, True, True]), (2, [True] * 4)):
        view = at.cameras[index]
        directions = view.directions_world(seen_uv[None])[0]
        middle = view.position_world + 5 * directions
        neighbours = Neighbours(torch.full((4, 1), index), torch.ones(4, 1, 4))
        views = FeatureCache(network, at, CPU).views(view, neighbours, middle)
        for stride, coarse in ((4, True), (1, False)):
            found = views.read(
                stride, middle[:, None], directions[:, None], torch.full((4, 1, 2), 0.5), torch.ones(4, 1), coarse
            )
            assert found.valid[:, 0, 0].tolist() == expected


def test_workers_that_share_a_gpu_have_a_part_each_of_what_it_has_free(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(feature_cache, "cores", lambda: 16)
    for total, free, threads, expected in (
        (80e9, 79e9, 16, MEMORY_SHARE * 80e9),
        (80e9, 79e9, 8, MEMORY_SHARE * 80e9),
        (80e9, 79e9, 1, FREE_SHARE * 79e9 / 16),
        (8e9, 7e9, 16, LEAST_BYTES),
        (24e9, 20e9, 1, FREE_SHARE * 20e9 / 16),
        (24e9, 2e9, 16, FREE_SHARE * 2e9),
    ):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _, found=(int(free), int(total)): found)
        assert memory_for_features(torch.device("cuda:1")) == int(expected)


@pytest.mark.usefixtures("small_blocks")
def test_maps_have_no_more_texels_than_are_counted_with_32_bits(network: Network, monkeypatch: pytest.MonkeyPatch):
    roomy = FeatureCache(network, scene(), CPU)
    monkeypatch.setattr(feature_cache, "MOST_TEXELS", 12 * 128**2)  # blocks of 64 pixels, a texel every half pixel
    limited = FeatureCache(network, scene(), CPU)
    assert limited.slots == 12 < roomy.slots
    assert max(len(maps.rows) for maps in feature_cache._maps(limited._encoded)) == 12 * 128**2


@pytest.mark.thorough
@pytest.mark.usefixtures("small_blocks")
def test_a_gpu_encodes_photographs_that_were_read_at_the_same_time(network: Network, monkeypatch: pytest.MonkeyPatch):
    at, readers = scene(), set[str]()
    found = [Renderer(network, at, UNMATCHED, CPU)(at.cameras[TARGET]).colour]
    read = FeatureCache._read

    def noted(self: FeatureCache, block: Block) -> BlockRead:
        readers.add(threading.current_thread().name)
        return read(self, block)

    monkeypatch.setattr(FeatureCache, "_read", noted)
    monkeypatch.setattr(feature_cache, "in_parallel", lambda tasks, _: [task() for task in tasks])
    for device in ("cpu", "cuda"):
        monkeypatch.setattr(feature_cache, "read_ahead", lambda read, keys, _, on=device: read_ahead(read, keys, on))
        readers.clear()
        found.append(Renderer(network, at, UNMATCHED, CPU)(at.cameras[TARGET]).colour)
        assert (threading.current_thread().name in readers) == (device == "cpu")
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


@pytest.mark.parametrize("channels", range(1, 9))
def test_rows_are_padded_to_whole_eight_bytes_and_no_more(channels: int):
    assert 2 * padded_channels(channels) % 8 == 0
    assert channels <= padded_channels(channels) < channels + 4
