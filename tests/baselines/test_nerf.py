"""Classical NeRF: its encoding and rays against closed forms, and that it learns, is resumed and renders."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch

from tidefield.baselines.nerf import Mlp, Nerf, NerfTrainer, Rays, draw_pixels, encode, make_render
from tidefield.config import Budget, NerfConfig
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import pixel_grid
from tidefield.parallel import interruptible
from tidefield.train.checkpoint import load_network

CPU = torch.device("cpu")
SMALL = NerfConfig(coarse=8, fine=8, depth=4, width=32, position_octaves=6, rays=128, learning_rate=5e-3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall.scene(wall.cameras(5), test=(2,))


class Fog(Mlp):
    """The same density and colour everywhere."""

    def forward(self, xyz, direction):
        return torch.full(xyz.shape[:2], 3.0), torch.full(xyz.shape, 0.25)


class Nothing(Mlp):
    """Empty space."""

    def forward(self, xyz, direction):
        return torch.full(xyz.shape[:2], -1.0), torch.zeros_like(xyz)


def fog() -> Nerf:
    network = Nerf(SMALL)
    network.coarse, network.fine = Fog(SMALL), Fog(SMALL)
    return network


def rays(count: int = 5) -> Rays:
    camera = wall.cameras(1)
    uv = pixel_grid(camera.width, camera.height)[:count]
    return Rays.of(camera, torch.zeros(count, dtype=torch.long), uv)


def test_positions_are_encoded_as_the_authors_code_does():
    x = torch.tensor([[0.3, -0.7, 0.1]])
    waves = [function(2**k * value) for k in range(4) for function in (math.sin, math.cos) for value in x[0].tolist()]
    by_octave = [w for k in range(4) for w in waves[6 * k : 6 * k + 6]]
    found = encode(x, 4)
    assert found.shape == (1, 27)
    assert sorted(found[0, 3:].tolist()) == pytest.approx(sorted(by_octave), abs=1e-6)
    torch.testing.assert_close(found[:, :3], x)


def test_fog_dims_as_beer_and_lambert_say():
    network, some = fog(), rays()
    network.radius.fill_(2.0)
    coarse, fine = network(some, opaque=False)
    length = some.direction_world.norm(dim=-1) / 2
    for seen in (coarse, fine):
        # The first sample lies within the first part of the interval, and what is before it counts as empty.
        first = seen.weights[:, 0]
        assert (first > 0).all()
        reach = -torch.log1p(-seen.opacity) / 3
        whole = (some.near_far[:, 1] - some.near_far[:, 0]) * length
        assert (reach <= whole + 1e-5).all()
        assert (reach > 0.9 * whole).all()
        torch.testing.assert_close(seen.colour, 0.25 * seen.opacity[:, None].expand(-1, 3))


def test_an_opaque_scene_stops_all_light():
    coarse, fine = fog()(rays(), opaque=True)
    for seen in (coarse, fine):
        torch.testing.assert_close(seen.opacity, torch.ones(5))


def test_fine_samples_lie_where_the_coarse_pass_saw_something():
    class Sheet(Mlp):
        """Nothing but a dense sheet at z = 5."""

        def forward(self, xyz, direction):
            there = (xyz[..., 2] - 5).abs() < 0.5
            return torch.where(there, 1e3, -1.0), torch.ones_like(xyz)

    network = Nerf(SMALL)
    network.coarse, network.fine = Sheet(SMALL), Sheet(SMALL)
    coarse, fine = network(rays(), opaque=False)
    assert (coarse.depth > 5.1).all()
    assert ((fine.depth > 4.5) & (fine.depth < 4.9)).all()
    assert (fine.opacity > 0.999).all()


def test_all_that_cameras_may_see_lies_between_minus_and_plus_one(scene: Scene):
    network = Nerf(SMALL)
    network.cover(scene.cameras)
    uv = pixel_grid(scene.cameras[0].width, scene.cameras[0].height)
    ends = scene.cameras.directions_world(uv.expand(len(scene.cameras), -1, -1))[:, :, None]
    points = scene.cameras.position_world[:, None, None] + ends * scene.cameras.near_far[:, None, :, None]
    inside = (points - network.centre_world) / network.radius
    assert inside.abs().max() <= 1
    assert inside.abs().max() > 0.9


def test_pixels_are_drawn_from_training_photographs_alone_with_their_own_colours(scene: Scene):
    which, uv, colour, _ = draw_pixels(scene, 500, torch.Generator().manual_seed(0))
    assert set(which.tolist()) == set(scene.train)
    for index, (u, v), rgb in zip(which.tolist(), uv.long().tolist(), colour, strict=True):
        torch.testing.assert_close(rgb * 255, scene.photographs[index][v, u].float())


@pytest.mark.thorough
def test_it_learns_a_wall(monkeypatch: pytest.MonkeyPatch):
    def ramps(xy: torch.Tensor) -> torch.Tensor:
        x, y = xy[..., 0], xy[..., 1]
        return (0.5 + 0.15 * torch.stack([x, y, x - y], -1)).clamp(0, 1)

    monkeypatch.setattr(wall, "texture", ramps)
    scene = wall.scene(wall.cameras(5), test=(2,))
    learner, budget = NerfTrainer(SMALL, scene, 0, CPU), Budget(steps=100)
    for _ in range(100):
        learner.step(budget)
    learner.network.eval()
    view = learner.renderer()(scene.cameras[2])
    assert view.colour.shape == (36, 48, 3)
    assert view.opacity.min() > 0.999
    truth = scene.photographs[2].float() / 255
    assert (view.colour - truth).square().mean() < 0.1 * truth.flatten(0, 1).var(0).mean()


def test_a_resumed_training_ends_bit_for_bit_where_an_unbroken_one_does(scene: Scene, tmp_path: Path):
    budget, unbroken = Budget(steps=4), NerfTrainer(SMALL, scene, 3, CPU)
    for _ in range(4):
        unbroken.step(budget)
    first = NerfTrainer(SMALL, scene, 3, CPU)
    for _ in range(2):
        first.step(budget)
    first.save(tmp_path)
    second = NerfTrainer(SMALL, scene, 99, CPU)
    second.resume(tmp_path)
    for _ in range(2):
        second.step(budget)
    for name, value in unbroken.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name


def test_a_background_shows_where_nothing_is(scene: Scene):
    network = Nerf(SMALL)
    network.coarse, network.fine = Nothing(SMALL), Nothing(SMALL)
    view = make_render(network, replace(scene, background_rgb=(1.0, 0.5, 0.0)), CPU)(scene.cameras[0])
    torch.testing.assert_close(view.colour, torch.tensor([1.0, 0.5, 0.0]).expand(36, 48, 3))
    torch.testing.assert_close(view.depth, scene.cameras[0].near_far.mean().expand(36, 48))


def test_the_depth_of_thin_fog_lies_within_it(scene: Scene):
    network = fog()
    network.radius.fill_(20.0)
    near, far = scene.cameras[0].near_far[0]
    view = make_render(network, replace(scene, background_rgb=(0.0, 0.0, 0.0)), CPU)(scene.cameras[0])
    assert view.opacity.max() < 0.9
    assert (view.depth > near + 0.2 * (far - near)).all()


def test_a_view_that_is_not_wanted_any_more_ends_at_the_next_rays(scene: Scene):
    started = []

    def check() -> None:
        started.append(1)
        if len(started) == 2:
            raise TimeoutError

    with interruptible(check), pytest.raises(TimeoutError):
        make_render(fog(), scene, CPU)(scene.cameras[0])


def test_nothing_is_learned_from_background_at_any_exposure(scene: Scene):
    white = tuple(torch.full_like(photograph, 255) for photograph in scene.photographs.colours)
    empty = replace(
        scene,
        cameras=wall.with_gains(scene.cameras),
        photographs=replace(scene.photographs, colours=white),
        background_rgb=(1.0, 1.0, 1.0),
    )
    learner = NerfTrainer(SMALL, empty, 0, CPU)
    learner.network.coarse, learner.network.fine = Nothing(SMALL), Nothing(SMALL)
    assert learner.loss()[0].item() == pytest.approx(0, abs=1e-10)


def test_masked_pixels_are_not_drawn(scene: Scene):
    masked = wall.with_left_halves_masked(scene, scene.train[:2])
    which, uv, colour, _ = draw_pixels(masked, 500, torch.Generator().manual_seed(0))
    everything = draw_pixels(scene, 500, torch.Generator().manual_seed(0))
    kept = (everything[1][:, 0] >= scene.cameras.width // 2) | ~torch.isin(everything[0], torch.tensor(scene.train[:2]))
    assert 100 < len(which) == kept.sum() < 500
    for drawn, all_of_them in zip((which, uv, colour), everything[:3], strict=True):
        assert torch.equal(drawn, all_of_them[kept])


def overexposed(scene: Scene) -> Scene:
    """White photographs, whose gain in the corners is a third of that in the middle of some."""
    shading = torch.zeros(5, 15, 3)
    shading[1, 3:] = -2.0
    cameras = replace(wall.with_gains(scene.cameras), shading=shading)
    white = tuple(torch.full_like(photograph, 255) for photograph in scene.photographs.colours)
    return replace(scene, cameras=cameras, photographs=replace(scene.photographs, colours=white))


class White(Mlp):
    """As bright as a network may be."""

    def forward(self, xyz, direction):
        return torch.full(xyz.shape[:2], 1e3), torch.ones_like(xyz)


def test_what_a_dark_photograph_overexposes_is_within_reach(scene: Scene, tmp_path: Path):
    white = overexposed(scene)
    learner = NerfTrainer(SMALL, white, 0, CPU)
    gains = torch.stack([white.cameras[i].gain_of_rows().amin((0, 1)) for i in white.train])
    assert gains.min() < 0.5
    torch.testing.assert_close(learner.network.headroom, gains.amin(0))
    learner.network.coarse = learner.network.fine = White(SMALL)
    for index in white.train:
        assert learner.renderer()(white.cameras[index]).colour.min() > 0.999
    # A held-out photograph's gain, however small, changes nothing.
    dark = replace(white.cameras, gain=white.cameras.gain.index_fill(0, torch.tensor([2]), 0.01))
    other = NerfTrainer(SMALL, replace(white, cameras=dark), 0, CPU)
    torch.testing.assert_close(other.network.headroom, learner.network.headroom)


def test_a_checkpoint_has_its_headroom_and_an_older_one_none(scene: Scene, tmp_path: Path):
    learner = NerfTrainer(SMALL, overexposed(scene), 0, CPU)
    learner.save(tmp_path)
    again = NerfTrainer(SMALL, scene, 0, CPU)
    assert (again.network.headroom == 1).all()
    load_network(tmp_path, again.network)
    torch.testing.assert_close(again.network.headroom, learner.network.headroom)
    del learner.network._buffers["headroom"]
    learner.save(tmp_path)
    load_network(tmp_path, again.network)
    assert (again.network.headroom == 1).all()
    again.resume(tmp_path)
