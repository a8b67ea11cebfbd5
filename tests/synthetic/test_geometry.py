"""Intersect rays with height field and plants, compared with brute force; grids and noise."""

import math

import numpy as np
import pytest
import torch

from tidefield.geometry.cameras import Cameras
from tidefield.synthetic import grids
from tidefield.synthetic.grids import Extent, Noise, Raster, box_pairs, resolved, smoothstep
from tidefield.synthetic.plants import Leaves, Plants, Stems
from tidefield.synthetic.rays import Parallel, Pinhole, height_field_depth

EXTENT = Extent(-6.0, -5.0, 61, 51, 0.2)


def bumpy_surface() -> Raster:
    x, y = EXTENT.nodes()
    z = 0.8 * torch.sin(1.3 * x) * torch.cos(0.9 * y) + 0.3 * torch.sin(4 * x + y)
    return Raster(EXTENT, z.reshape(1, EXTENT.rows, EXTENT.columns))


def random_plants(random: np.random.Generator) -> Plants:
    def draw(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.from_numpy(random.uniform(low, high, shape)).float()

    centre = torch.cat([draw(-4, 4, 2, 40), draw(0.5, 3, 1, 40)])
    u = draw(-0.5, 0.5, 3, 40)
    v = torch.linalg.cross(u, draw(-1, 1, 3, 40), dim=0)
    leaves = Leaves(
        centre, u, v, draw(3, 9, 40).round(), draw(0, 6, 40), draw(0, 0.8, 40), draw(0, 1, 3, 40), draw(0, 1, 40)
    )
    start = torch.cat([draw(-4, 4, 2, 15), draw(-1, 1, 1, 15)])
    return Plants(leaves, Stems(start, start + draw(-1.5, 1.5, 3, 15), draw(0.02, 0.3, 15), draw(0, 1, 3, 15)))


def make_camera(width: int = 40, tilt: float = 0.4) -> Cameras:
    sin, cos = math.sin(tilt), math.cos(tilt)
    pose = torch.tensor([[[1.0, 0, 0, 0.3], [0, -cos, sin, -4.0], [0, -sin, -cos, 9.0]]])
    size = torch.tensor([[width, width * 3 // 4]])
    ones = torch.ones(1, 2)
    return Cameras(pose, ones * width, size / 2, size, ones, torch.ones(1, 3))


def brute_force(plants: Plants, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the first depth of one ray: leaves by their definition, stems by small steps along the ray."""
    leaves = plants.leaves
    c, u, v = (x.T.double().numpy() for x in (leaves.centre, leaves.u, leaves.v))
    lobes, phase, notch = (x.double().numpy() for x in (leaves.lobes, leaves.phase, leaves.notch))
    matrix = np.stack([np.broadcast_to(direction, u.shape), -u, -v], axis=-1)
    t, a, b = np.linalg.solve(matrix, (c - origin)[..., None])[..., 0].T
    met = (t > 0) & (np.hypot(a, b) <= 1 - notch * (1 + np.cos(lobes * np.arctan2(b, a) + phase)) / 2)
    nearest = float(t[met].min(initial=math.inf))
    depth = np.arange(0, 16, 0.004)
    points = origin[:, None] + direction[:, None] * depth
    for start, end, radius in zip(plants.stems.start.T, plants.stems.end.T, plants.stems.radius, strict=True):
        a, axis = start.double().numpy()[:, None], (end - start).double().numpy()[:, None]
        along = np.clip(((points - a) * axis).sum(0) / (axis**2).sum(), 0, 1)
        inside = np.linalg.norm(points - a - along * axis, axis=0) < float(radius)
        if inside.any():
            nearest = min(nearest, float(depth[inside.argmax()]))
    return nearest


@pytest.mark.thorough
def test_plant_depths_match_brute_force() -> None:
    plants = random_plants(np.random.default_rng(1))
    sun = torch.tensor([0.5, 0.3, 0.8])
    views = [
        Pinhole(make_camera(), split=2),
        Parallel.straight_down(EXTENT, 8.0),
        Parallel.along_sun(EXTENT, -2.0, 5.0, sun / sun.norm()),
    ]
    for view in views:
        depth, number = plants.nearest(view)
        ray = torch.arange(0, len(depth), len(depth) // 200)
        origin, direction = (x.expand(3, len(ray)).double().numpy() for x in view.rays(ray))
        expected = np.array([brute_force(plants, o, d) for o, d in zip(origin.T, direction.T, strict=True)])
        hit = np.isfinite(expected)
        assert 10 < hit.sum() < len(ray)
        # Rays along an edge may fall on either side of it in different arithmetic.
        assert (np.isfinite(depth[ray].numpy()) == hit).mean() > 0.99
        both = hit & np.isfinite(depth[ray].numpy())
        assert (np.abs(depth[ray].numpy()[both] - expected[both]) < 6e-3).mean() > 0.98
        assert torch.equal(number >= 0, torch.isfinite(depth))


def test_stems_far_below_are_as_in_double_precision() -> None:
    """Prop roots of a mangrove, 120 m below the camera."""
    random = np.random.default_rng(0)
    count, radius = 20_000, 0.035
    turn = random.uniform(0, 2 * math.pi, count)
    start = np.stack([*random.uniform(-20, 20, (2, count)), random.uniform(0, 1, count)])
    end = start + np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(count, 0.3)])
    across = np.stack([-np.sin(turn), np.cos(turn), np.zeros(count)])
    aim = 0.5 * (start + end) + across * random.uniform(-3 * radius, 3 * radius, count)
    eye = np.array([[0.0], [0.0], [120.0]])
    depths = []
    for kind in (np.float32, np.float64):
        a, b, origin, to = (torch.from_numpy(x.astype(kind)) for x in (start, end, eye, (aim - eye) / 120))
        stems = Stems(a, b, torch.full_like(a[0], radius), torch.zeros_like(a))
        depths.append(stems.depth(torch.arange(count), (origin, to)).double())
    hit = torch.isfinite(torch.stack(depths))
    assert 0.2 < hit[1].double().mean() < 0.8
    assert (hit[0] != hit[1]).double().mean() < 0.005
    assert (depths[0] - depths[1])[hit.all(0)].abs().max() < 1e-3


def test_height_field_depths_match_small_steps() -> None:
    raster = bumpy_surface()
    for tilt in (0.0, 0.9):
        view = Pinhole(make_camera(24, tilt))
        ray = torch.arange(view.columns * view.rows)
        origin, direction = view.rays(ray)
        depth = height_field_depth(raster, (origin, direction))
        walk = torch.arange(5, 30, 0.004)[:, None]
        points = origin[:, None] + direction[:, None] * walk
        gap = points[2] - raster.sample(points[:2].reshape(2, -1))[0].reshape(points.shape[1:])
        first = walk[(gap < 0).float().argmax(0), 0]
        below = (gap < 0).any(0)
        assert below.float().mean() > 0.9
        # A ray may dip under a crest between two of the small steps: then the small steps are wrong, and later.
        assert ((depth - first)[below] < 1e-3).all()
        assert ((depth - first)[below].abs() < 5e-3).float().mean() > 0.99
        at = origin + direction * depth
        assert (at[2] - raster.sample(at[:2])[0])[below].abs().max() < 2e-4


def test_rising_and_level_rays_miss_the_ground() -> None:
    direction = torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.0, 0.3], [0.0, 0.5, 0.4]])
    depth = height_field_depth(bumpy_surface(), (torch.tensor([[0.0], [0.0], [5.0]]), direction))
    assert torch.isinf(depth).all()


def test_max_slope_is_a_tight_bound() -> None:
    raster = bumpy_surface()
    random = torch.Generator().manual_seed(0)
    xy = torch.rand(2, 4000, generator=random) * torch.tensor([[11.8], [9.8]]) + torch.tensor([[-5.9], [-4.9]])
    angle = torch.rand(4000, generator=random) * 2 * math.pi
    step = 0.01 * torch.stack([angle.cos(), angle.sin()])
    rise = (raster.sample(xy + step)[0] - raster.sample(xy)[0]).abs() / 0.01
    assert 0.8 * raster.max_slope < rise.max() < 1.001 * raster.max_slope


def test_raster_interpolates_nodes_exactly_and_extends_its_border() -> None:
    raster = bumpy_surface()
    nodes = EXTENT.nodes()
    assert torch.allclose(raster.sample(nodes)[0], raster.values.reshape(-1), atol=1e-5)
    outside = raster.sample(torch.tensor([[-100.0], [EXTENT.south_m]]))
    assert torch.allclose(outside[0, 0], raster.values[0, 0, 0])


@pytest.mark.parametrize("pairs_at_once", [17, 1 << 20])
def test_box_pairs_list_every_cell_once_in_order(pairs_at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grids, "_PAIRS", pairs_at_once)
    random = torch.Generator().manual_seed(3)
    first = torch.randint(0, 20, (2, 30), generator=random)
    boxes = torch.cat([first, first + torch.randint(-1, 6, (2, 30), generator=random)])
    blocks = [torch.stack(pair, dim=1) for pair in box_pairs(boxes, columns=40)]
    expected = [
        [i, row * 40 + column]
        for i, (u0, v0, u1, v1) in enumerate(boxes.T.tolist())
        for row in range(v0, v1 + 1)
        for column in range(u0, u1 + 1)
    ]
    assert torch.cat(blocks).tolist() == expected
    assert len(blocks) > 10 if pairs_at_once == 17 else len(blocks) == 1


def test_smoothstep_rises_falls_and_is_symmetric() -> None:
    x = np.array([-1.0, 0.0, 0.25, 0.5, 0.75, 1.0, 2.0])
    assert np.allclose(smoothstep(0.0, 1.0, x), [0, 0, 5 / 32, 0.5, 27 / 32, 1, 1])
    assert np.allclose(smoothstep(1.0, 0.0, x), 1 - smoothstep(0.0, 1.0, x))
    assert torch.allclose(smoothstep(0.0, 1.0, torch.from_numpy(x)), torch.from_numpy(smoothstep(0.0, 1.0, x)))


def test_detail_fades_out_around_the_nyquist_limit() -> None:
    share = resolved(0.6, torch.tensor([0.1, 0.2, 0.3, 0.4, 0.8]))
    assert torch.equal(share[:2], torch.ones(2))
    assert 0 < share[2] < 0.5
    assert torch.equal(share[3:], torch.zeros(2))


def test_noise_is_periodic_bounded_and_takes_its_lattice_values() -> None:
    noise = Noise(np.random.default_rng(5), channels=3)
    xy = torch.rand(2, 500, generator=torch.Generator().manual_seed(0)) * 200
    values = noise.octave(xy, 2.0, 0)
    assert values.shape == (3, 500)
    assert values.abs().max() <= 1
    # Octave 0 is neither turned nor shifted: 256 cells of 2 m are one period.
    assert torch.allclose(noise.octave(xy + 512.0, 2.0, 0), values, atol=2e-3)
    assert torch.allclose(noise.octave(torch.tensor([[6.0], [10.0]]), 2.0, 0)[:, 0], noise.table[0, :, 5, 3], atol=1e-4)
    west, east = noise.table[0, :, 5, 3], noise.table[0, :, 5, 4]
    quarter = noise.octave(torch.tensor([[6.5], [10.0]]), 2.0, 0)[:, 0]
    assert torch.allclose(quarter, torch.lerp(west, east, 5 / 32), atol=1e-4)
    assert 0.3 < float(noise.fractal(xy, 9.0, 4).abs().max()) < 1.6
