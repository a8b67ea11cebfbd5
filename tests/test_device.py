"""The machine: which device to compute on, and how."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from tidefield import device
from tidefield.device import choose_device, mixed_precision
from tidefield.errors import DeviceError

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def untried() -> Iterator[None]:
    device._cpu_gains_by_bfloat16.cache_clear()
    yield
    device._cpu_gains_by_bfloat16.cache_clear()


def clock(monkeypatch: pytest.MonkeyPatch, seconds: dict[torch.dtype, float]) -> list[torch.dtype]:
    """Convolutions take so long; returns what was convolved."""
    tried: list[torch.dtype] = []
    now = [0.0]

    def convolve(images: torch.Tensor, weight: torch.Tensor, padding: int) -> None:
        tried.append(images.dtype)
        now[0] += seconds[images.dtype]

    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(device, "conv2d", convolve)
    monkeypatch.setattr(device, "perf_counter", lambda: now[0])
    return tried


def product() -> torch.dtype:
    with mixed_precision(CPU):
        return (torch.ones(2, 2) @ torch.ones(2, 2)).dtype


@pytest.mark.parametrize(("half", "expected"), [(1.0, torch.bfloat16), (4.0, torch.float32)])
def test_cpus_use_bfloat16_only_where_it_is_faster(
    monkeypatch: pytest.MonkeyPatch, half: float, expected: torch.dtype
) -> None:
    tried = clock(monkeypatch, {torch.float32: 2.0, torch.bfloat16: half})
    assert [product(), product()] == [expected, expected]
    assert set(tried) == {torch.float32, torch.bfloat16}
    assert len(tried) == 2 * (1 + device._TRIES), "tried once, not for every step"


def test_nothing_is_tried_where_the_cpu_cannot_have_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = clock(monkeypatch, {})
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    assert product() == torch.float32
    assert not tried


def test_the_trial_changes_no_random_numbers() -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    product()
    assert torch.equal(torch.rand(3), expected)


def test_an_unknown_device_is_refused() -> None:
    assert choose_device("cpu") == CPU
    with pytest.raises(DeviceError, match="there is no device 'tpu'"):
        choose_device("tpu")


def test_mps_is_taken_only_where_it_has_all_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(*_: object, **__: object) -> None:
        raise NotImplementedError("The operator 'aten::_embedding_bag' is not currently implemented for the MPS device")

    assert device._has_all(CPU)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with monkeypatch.context() as patch:
        patch.setattr(device, "_has_all", lambda _: True)
        assert choose_device("auto") == choose_device("mps") == torch.device("mps")
    monkeypatch.setattr(device, "embedding_bag", lacking)
    assert not device._has_all(CPU)
    assert choose_device("auto") == CPU
    with pytest.raises(DeviceError, match="lacks what our networks need on MPS: expected a later one"):
        choose_device("mps")
