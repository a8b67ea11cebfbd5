"""Rays against height field and plants, compared with brute force."""

import math

import numpy as np
import torch

from tidefield.geometry.cameras import Cameras
from tidefield.synthetic.march import march
from tidefield.synthetic.primitives import Leaves, Plants, Stems, box_pairs
from tidefield.synthetic.raster import Extent, Raster
from tidefield.synthetic.views import Pinhole, along_the_sun, straight_down

EXTENT = Extent(-6.0, -5.0, 61, 51, 0.2)


def bumpy() -> Raster:
    x, y = EXTENT.nodes()
    return Raster.of(EXTENT, 0.8 * torch.sin(1.3 * x) * torch.cos(0.9 * y) + 0.3 * torch.sin(4 * x + y))


def some_plants(random: np.random.Generator) -> Plants:
    def draw(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.from_numpy(random.uniform(low, high, shape)).float()

    place = torch.cat([draw(-4, 4, 2, 40), draw(0.5, 3, 1, 40)])
    u = draw(-0.5, 0.5, 3, 40)
    v = torch.linalg.cross(u, draw(-1, 1, 3, 40), dim=0)
    leaves = Leaves(
        place, u, v, draw(3, 9, 40).round(), draw(0, 6, 40), draw(0, 0.8, 40), draw(0, 1, 3, 40), draw(0, 1, 40)
    )
    start = torch.cat([draw(-4, 4, 2, 15), draw(-1, 1, 1, 15)])
    return Plants(leaves, Stems(start, start + draw(-1.5, 1.5, 3, 15), draw(0.02, 0.3, 15), draw(0, 1, 3, 15)))


def a_camera(width: int = 40, tilt: float = 0.4) -> Cameras:
    sin, cos = math.sin(tilt), math.cos(tilt)
    pose = torch.tensor([[[1.0, 0, 0, 0.3], [0, -cos, sin, -4.0], [0, -sin, -cos, 9.0]]])
    size = torch.tensor([[width, width * 3 // 4]])
    ones = torch.ones(1, 2)
    return Cameras(pose, ones * width, size / 2, size, ones, torch.ones(1, 3))


def brute_force(plants: Plants, origin: np.ndarray, direction: np.ndarray) -> float:
    """Nearest meeting of one ray: leaves by their definition, stems by walking along the ray."""
    nearest = math.inf
    leaves = plants.leaves
    for i in range(len(leaves)):
        c, u, v = (x[:, i].double().numpy() for x in (leaves.centre, leaves.u, leaves.v))
        t, a, b = np.linalg.solve(np.column_stack([direction, -u, -v]), c - origin)
        angle = float(leaves.lobes[i]) * math.atan2(b, a) + float(leaves.phase[i])
        if t > 0 and math.hypot(a, b) <= 1 - float(leaves.notch[i]) * (1 + math.cos(angle)) / 2:
            nearest = min(nearest, t)
    depth = np.arange(0, 16, 0.004)
    points = origin[:, None] + direction[:, None] * depth
    for start, end, radius in zip(plants.stems.start.T, plants.stems.end.T, plants.stems.radius, strict=True):
        a, axis = start.double().numpy()[:, None], (end - start).double().numpy()[:, None]
        along = np.clip(((points - a) * axis).sum(0) / (axis**2).sum(), 0, 1)
        inside = np.linalg.norm(points - a - along * axis, axis=0) < float(radius)
        if inside.any():
            nearest = min(nearest, float(depth[inside.argmax()]))
    return nearest


def test_plants_are_met_where_brute_force_meets_them() -> None:
    plants = some_plants(np.random.default_rng(1))
    sun = torch.tensor([0.5, 0.3, 0.8])
    views = [
        Pinhole(a_camera(), split=2),
        straight_down(EXTENT, 8.0),
        along_the_sun(EXTENT, -2.0, 5.0, sun / sun.norm(), 0.25),
    ]
    for view in views:
        depth, number = plants.nearest(view)
        ray = torch.arange(0, len(depth), len(depth) // 250)
        origin, direction = (x.expand(3, len(ray)).double().numpy() for x in view.rays(ray))
        expected = np.array([brute_force(plants, o, d) for o, d in zip(origin.T, direction.T, strict=True)])
        met = np.isfinite(expected)
        assert 10 < met.sum() < len(ray)
        # Rays along an edge may fall on either side of it in different arithmetic.
        assert (np.isfinite(depth[ray].numpy()) == met).mean() > 0.99
        both = met & np.isfinite(depth[ray].numpy())
        assert (np.abs(depth[ray].numpy()[both] - expected[both]) < 6e-3).mean() > 0.98
        assert torch.equal(number >= 0, torch.isfinite(depth))


def test_the_ground_is_met_where_small_steps_meet_it_first() -> None:
    raster = bumpy()
    for tilt in (0.0, 0.9):
        view = Pinhole(a_camera(24, tilt))
        ray = torch.arange(view.columns * view.rows)
        origin, direction = view.rays(ray)
        depth = march(raster, raster.steepest(), origin, direction)
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


def test_rays_that_rise_or_run_level_meet_no_ground() -> None:
    direction = torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.0, 0.3], [0.0, 0.5, 0.4]])
    depth = march(bumpy(), bumpy().steepest(), torch.tensor([[0.0], [0.0], [5.0]]), direction)
    assert torch.isinf(depth).all()


def test_no_part_of_the_surface_is_steeper_than_its_bound() -> None:
    raster = bumpy()
    random = torch.Generator().manual_seed(0)
    xy = torch.rand(2, 4000, generator=random) * torch.tensor([[11.8], [9.8]]) + torch.tensor([[-5.9], [-4.9]])
    angle = torch.rand(4000, generator=random) * 2 * math.pi
    step = 0.01 * torch.stack([angle.cos(), angle.sin()])
    rise = (raster.sample(xy + step)[0] - raster.sample(xy)[0]).abs() / 0.01
    assert 0.8 * raster.steepest() < rise.max() < 1.001 * raster.steepest()


def test_boxes_are_emptied_into_all_their_cells_once() -> None:
    boxes = torch.tensor([[1, 3, 2], [0, 2, 5], [2, 3, 1], [1, 4, 9]])
    pairs = [torch.stack(pair, dim=1) for pair in box_pairs(boxes, columns=10)]
    expected = {(0, r * 10 + c) for r in (0, 1) for c in (1, 2)} | {(1, r * 10 + 3) for r in (2, 3, 4)}
    assert sorted(map(tuple, torch.cat(pairs).tolist())) == sorted(expected)


def test_a_raster_gives_back_its_nodes_and_goes_on_beyond_its_border() -> None:
    raster = bumpy()
    nodes = EXTENT.nodes()
    assert torch.allclose(raster.sample(nodes)[0], raster.values.reshape(-1), atol=1e-5)
    outside = raster.sample(torch.tensor([[-100.0], [EXTENT.south_m]]))
    assert torch.allclose(outside[0, 0], raster.values[0, 0, 0])
