import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from tidefield.model.colour import HIGHEST_DEGREE, basis, expand

DEGREES = range(HIGHEST_DEGREE + 1)


def directions(count: int = 50) -> Tensor:
    """Random unit vectors, and the six along the axes, where angles are no good coordinates."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)
    return torch.nn.functional.normalize(torch.cat([drawn, axes, -axes]), dim=-1)


def from_scipy(unit: Tensor, degree: int) -> np.ndarray:
    """Method.md, section 8, from the complex harmonics, whose P carries the Condon-Shortley sign."""
    x, y, z = unit.numpy().T
    theta, phi = np.arccos(z.clip(-1, 1)), np.arctan2(y, x)
    columns = []
    for j in range(degree + 1):
        for m in range(-j, j + 1):
            value = sph_harm_y(j, abs(m), theta, phi)
            columns.append(value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(columns, -1)


@pytest.mark.parametrize("degree", DEGREES)
def test_the_basis_is_scipys_with_the_sign_of_the_paper(degree: int):
    unit = directions()
    values = basis(unit, degree)
    assert values.shape == (len(unit), (degree + 1) ** 2)
    np.testing.assert_allclose(values.numpy(), from_scipy(unit, degree), atol=1e-14)


def test_the_first_terms_are_those_of_instant_ngp():
    x, y, z = directions().T
    scale = math.sqrt(3 / (4 * math.pi))
    constant = torch.full_like(x, 0.28209479177387814)
    torch.testing.assert_close(basis(directions(), 1), torch.stack([constant, -scale * y, scale * z, -scale * x], -1))


@pytest.mark.parametrize("degree", DEGREES)
def test_the_basis_is_orthonormal_on_the_sphere(degree: int):
    # Exact for products of two harmonics: polynomials in z up to 2 J, waves in phi up to 2 J.
    z, weight = np.polynomial.legendre.leggauss(degree + 1)
    turns = 2 * degree + 1
    phi = 2 * np.pi * np.arange(turns) / turns
    z, phi = (a.reshape(-1) for a in np.meshgrid(z, phi, indexing="ij"))
    area = np.repeat(weight, turns) * 2 * np.pi / turns
    sine = np.sqrt(1 - z**2)
    values = basis(torch.from_numpy(np.stack([sine * np.cos(phi), sine * np.sin(phi), z], -1)), degree).numpy()
    np.testing.assert_allclose((values * area[:, None]).T @ values, np.eye((degree + 1) ** 2), atol=1e-13)


def test_a_colour_is_the_sum_of_coefficients_times_basis_per_channel():
    unit = directions(5)
    values = basis(unit, 3)
    coefficients = torch.randn(len(unit), 3, 16, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.zeros(len(unit), 3, dtype=torch.float64)
    for p in range(len(unit)):
        for channel in range(3):
            for k in range(16):
                expected[p, channel] += coefficients[p, channel, k] * values[p, k]
    torch.testing.assert_close(expand(coefficients, values), expected)


def test_gradients_are_right_everywhere_also_at_the_poles():
    assert torch.autograd.gradcheck(lambda d: basis(d, 4), directions(4).requires_grad_())


def test_a_degree_beyond_the_highest_is_refused():
    with pytest.raises(AssertionError, match="degree 5"):
        basis(directions(1), HIGHEST_DEGREE + 1)
