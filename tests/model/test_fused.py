"""The kernels beside their plain twins, in Triton's interpreter: no GPU is needed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed: it is for Linux")

from tidefield.model import fused
from tidefield.model.aggregate import weighted_moments
from tidefield.model.gather import FeatureMaps, gather, joined, maps_from_images

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WHICH = torch.tensor([[0, 2], [1, 1]], device=DEVICE)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(DEVICE)


def maps(stride: int | float, channels: int) -> FeatureMaps:
    corners = torch.tensor([[0.0, 0.0], [5.0, 7.0]], device=DEVICE)
    several = maps_from_images(draw(2, channels, 20, 30), corners, stride)
    return joined(
        [several, maps_from_images(draw(1, channels, 13, 17, seed=1), torch.zeros(1, 2, device=DEVICE), stride)]
    )


def pixels(stride: int | float) -> Tensor:
    """On the maps, beside them, and nowhere."""
    uv = torch.rand(2, 2, 150, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([40.0, 30.0]) - 5
    uv[0, 0, 0], uv[0, 0, 1] = torch.nan, 1e20
    return (uv * stride).to(DEVICE)


def read(own: FeatureMaps, uv: Tensor) -> tuple[Tensor, Tensor]:
    of = (own.first[WHICH].flatten(), own.size[WHICH].flatten(0, 1), own.origin_px[WHICH].flatten(0, 1))
    values, there = fused.read(own.rows, *of, own.stride, uv.flatten(0, 1))
    return values.unflatten(0, (2, 2)), there.unflatten(0, (2, 2))


@pytest.mark.parametrize(("stride", "channels"), [(1, 16), (0.5, 3), (4, 35)])
def test_reading_is_that_of_the_twin_forwards_and_backwards(stride: int | float, channels: int) -> None:
    own, uv = maps(stride, channels), pixels(stride)
    own = replace(own, rows=own.rows.requires_grad_())
    expected, on_map = gather(own, WHICH, uv)
    values, there = read(own, uv)
    torch.testing.assert_close(values, expected, atol=1e-5, rtol=0)
    assert torch.equal(there, on_map)
    assert 0.2 < there.float().mean() < 0.95
    upstream = draw(*values.shape, seed=3)
    ours, theirs = (torch.autograd.grad((v * upstream).sum(), own.rows)[0] for v in (values, expected))
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0)


def test_maps_in_half_precision_are_read_in_single() -> None:
    own, uv = maps(1, 16), pixels(1)
    values, _ = read(replace(own, rows=own.rows.half()), uv)
    assert values.dtype == torch.float32
    torch.testing.assert_close(values, gather(own, WHICH, uv)[0], atol=5e-3, rtol=0)


@pytest.mark.parametrize("unseen", [False, True])
def test_moments_are_those_of_the_twin_forwards_and_backwards(unseen: bool) -> None:
    values = draw(2, 5, 70, 16).requires_grad_()
    weight = torch.rand(2, 5, 70, generator=torch.Generator().manual_seed(1))
    weight = (weight / weight.sum(1, keepdim=True)).to(DEVICE)
    weight[:, :, :9] *= not unseen  # no view sees these: their weights sum to 0
    weight.requires_grad_()
    expected, found = weighted_moments(values, weight), fused.moments(values, weight)
    upstream = [draw(*part.shape, seed=4 + k) for k, part in enumerate(found)]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=0)

    def gradients(parts: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        total = sum((part * u).sum() for part, u in zip(parts, upstream, strict=True))
        return torch.autograd.grad(total, (values, weight))

    for one, other in zip(gradients(found), gradients(expected), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=0)


@pytest.mark.gpu
@pytest.mark.skipif(DEVICE.type == "cpu", reason="there is no CUDA device")
def test_they_are_used_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    own, uv = maps(1, 16), pixels(1)
    expected, _ = gather(own, WHICH, uv)
    monkeypatch.setenv("TIDEFIELD_FUSED", "1")
    monkeypatch.setattr(fused, "read", lambda *words: pytest.fail("asked"))
    with pytest.raises(pytest.fail.Exception, match="asked"):
        gather(own, WHICH, uv)
    monkeypatch.undo()
    torch.testing.assert_close(read(own, uv)[0], expected, atol=1e-5, rtol=0)
