import itertools

import pytest
import torch
from random_weights import randomise
from torch import Tensor
from torch.nn import functional as F

from tidefield.config import FieldConfig
from tidefield.model.field import Field, contract

DENSE = FieldConfig(levels=1, features=3, log2_entries=10, coarsest=8, finest=8)
HASHED = FieldConfig(levels=1, features=3, log2_entries=6, coarsest=8, finest=8)
MANY = FieldConfig(levels=5, features=2, log2_entries=9, coarsest=4, finest=64)


def spots(count: int, reach: float) -> Tensor:
    """Random positions up to `reach` from the origin."""
    generator = torch.Generator().manual_seed(0)
    way = F.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return way * reach * torch.rand(count, 1, generator=generator, dtype=torch.float64)


def field(config: FieldConfig) -> Field:
    return randomise(Field(config).double())


def test_contraction_leaves_the_unit_ball_as_it_is():
    inside = spots(100, 1.0)
    torch.testing.assert_close(contract(inside), inside)


def test_contraction_brings_all_of_space_within_radius_two_in_its_own_direction():
    outside = spots(100, 50.0) + F.normalize(spots(100, 50.0), dim=-1)
    result = contract(outside)
    length = outside.norm(dim=-1)
    torch.testing.assert_close(result.norm(dim=-1), 2 - 1 / length)
    torch.testing.assert_close(F.normalize(result, dim=-1), F.normalize(outside, dim=-1))
    assert contract(torch.tensor([[1e12, 0.0, -1e12]])).norm() <= 2 + 1e-6


def test_contraction_is_continuous_and_smooth_at_the_unit_sphere():
    way = F.normalize(spots(20, 1.0), dim=-1)
    torch.testing.assert_close(contract(way * (1 + 1e-9)), contract(way * (1 - 1e-9)), atol=1e-8, rtol=0)
    slope = [(contract(way * (1 + e)) - contract(way)) / e for e in (1e-6, -1e-6)]
    torch.testing.assert_close(slope[0], slope[1], atol=1e-5, rtol=0)


def test_contraction_has_finite_gradients_also_at_the_origin():
    x = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], dtype=torch.float64, requires_grad=True)
    contract(x).square().sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()
    assert torch.autograd.gradcheck(contract, spots(10, 5.0).requires_grad_())


def world(grid: Tensor, resolution: int = 8) -> Tensor:
    """Positions within the unit ball of grid coordinates: the ball of radius 2 fills the grid."""
    return (grid / resolution - 0.5) * 4


@pytest.mark.parametrize("config", [DENSE, HASHED])
def test_features_are_trilinear_between_the_grid_points(config: FieldConfig):
    own = field(config)
    cell = torch.tensor([3.0, 4.0, 3.0], dtype=torch.float64)
    part = torch.tensor([0.2, 0.7, 0.4], dtype=torch.float64)
    expected = torch.zeros(3, dtype=torch.float64)
    for bits in itertools.product((0, 1), repeat=3):
        corner = torch.tensor(bits, dtype=torch.float64)
        share = torch.where(corner.bool(), part, 1 - part).prod()
        expected += share * own(world(cell + corner)[None])[0]
    torch.testing.assert_close(own(world(cell + part)[None])[0], expected)


def test_at_grid_points_features_are_single_entries_of_the_table():
    own = field(DENSE)
    line = torch.arange(3, 6, dtype=torch.float64)
    points = torch.cartesian_prod(line, line, line)
    values = own(world(points))
    same = (values[:, None] - own.table[None]).abs().amax(-1) < 1e-9
    assert (same.sum(1) == 1).all(), "not an entry"
    assert len(same.nonzero()[:, 1].unique()) == 27, "two grid points share an entry of a level that fits"


@pytest.mark.parametrize("config", [DENSE, HASHED, MANY])
def test_features_are_continuous_everywhere(config: FieldConfig):
    own = field(config)
    start, end = torch.tensor([[-3.0, -2.0, 1.0], [2.5, 3.0, -2.0]], dtype=torch.float64)
    line = start + (end - start) * torch.linspace(0, 1, 20001, dtype=torch.float64)[:, None]
    assert own(line).diff(dim=0).abs().max() < 0.02 * own.table.std()


def test_gradients_reach_the_tables_entries_by_their_shares():
    own = field(HASHED)
    points = spots(5, 3.0)

    def read(table: Tensor) -> Tensor:
        return torch.func.functional_call(own, {"table": table}, (points,))

    assert torch.autograd.gradcheck(read, own.table.detach().clone().requires_grad_())


def test_every_point_moves_each_level_by_one_in_total():
    own = field(MANY)
    own(spots(40, 3.0)).sum().backward()
    assert own.table.grad is not None
    per_level = own.table.grad.reshape(5, -1, 2).sum(1)
    torch.testing.assert_close(per_level, torch.full((5, 2), 40.0, dtype=torch.float64))


def test_levels_go_from_the_coarsest_to_the_finest_by_a_constant_factor():
    assert Field(FieldConfig()).resolutions[0] == 16
    assert Field(FieldConfig()).resolutions[-1] in (2047, 2048)
    assert Field(MANY).resolutions == (4, 8, 16, 32, 64)
    assert Field(MANY).channels == 10


def test_a_field_that_covers_a_moved_and_larger_scene_says_the_same():
    own, points = field(MANY), spots(30, 3.0)
    before, unit = own(points), own.unit.clone()
    centre = torch.tensor([100.0, -40.0, 7.0], dtype=torch.float64)
    own.cover(centre, 25.0)
    torch.testing.assert_close(own(points * 25 + centre), before)
    torch.testing.assert_close(own.unit, unit * 25)


def test_where_a_field_lies_is_stored_with_its_weights():
    own = field(MANY)
    own.cover(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 4.0)
    other = Field(MANY).double()
    other.load_state_dict(own.state_dict())
    torch.testing.assert_close(other(spots(10, 9.0)), own(spots(10, 9.0)))


def test_points_at_any_distance_have_features():
    far = torch.tensor([[1e6, 0, 0], [-1e9, 1e9, 0], [0, 0, 1e12], [1e12, 0, 0]])
    one_dense_level = FieldConfig(levels=1, coarsest=16, finest=16, log2_entries=13)
    for config in (FieldConfig(), one_dense_level):
        assert Field(config)(far).isfinite().all()
