"""Parts of a batch on cores of their own: the same results and gradients as all at once."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import pytest
import textured_wall as wall
import torch
from torch import Tensor, nn

from tidefield.config import SWIFT
from tidefield.data.batches import draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.model.network import make_network
from tidefield.parallel import SharedValues, differentiable_parts, in_parallel, read_ahead
from tidefield.train.losses import BatchLoss, Inputs

CPU = torch.device("cpu")


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


class Layers(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first, self.second, self.idle = nn.Linear(3, 4), nn.Linear(4, 2), nn.Linear(2, 2)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        hidden = self.first(x).tanh()
        return hidden, self.second(hidden), x.sum(1)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad, torch.enable_grad])
def test_tasks_run_in_the_modes_of_their_caller(mode) -> None:
    def modes() -> tuple[bool, bool]:
        return torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    with mode():
        assert in_parallel([modes] * 3, CPU) == [modes()] * 3


@pytest.mark.usefixtures("two_threads")
def test_a_thread_that_starts_while_others_work_has_all_cores() -> None:
    both, found = threading.Barrier(2), []

    def meet() -> int:
        both.wait(timeout=10)  # broken if one after the other
        return torch.get_num_threads()

    def start() -> None:
        other = threading.Thread(target=lambda: found.extend(in_parallel([meet, meet], CPU)))
        other.start()
        other.join()

    in_parallel([start, lambda: None], CPU)
    assert found == [1, 1]
    fresh = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    fresh.start()
    fresh.join()
    assert found[-1] == torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_tasks_of_a_task_run_on_its_core() -> None:
    def names() -> str:
        return threading.current_thread().name

    def both() -> tuple[str, list[str]]:
        return names(), in_parallel([names, names], CPU)

    for own, others in in_parallel([both, both], CPU):
        assert others == [own, own]


@pytest.mark.usefixtures("two_threads")
def test_what_tasks_on_a_gpu_ask_for_in_turn_is_read_at_the_same_time() -> None:
    both, reads = threading.Barrier(2), []

    def read(key: int) -> int:
        if key < 2:
            both.wait(timeout=10)  # broken unless the other one is read meanwhile
        reads.append(key)
        return 10 * key

    with read_ahead(read, [0, 1, 2], "cuda") as asked:
        assert [asked(key) for key in (0, 1, 2, 3)] == [0, 10, 20, 30]
    assert sorted(reads) == [0, 1, 2, 3], "each is read once"
    with read_ahead(read, [0, 1], CPU) as asked:
        assert asked is read


def test_what_cannot_be_read_ahead_is_an_error_of_the_task_that_asks_for_it() -> None:
    with read_ahead(lambda key: 1 // key, [0, 1], "cuda") as asked:
        assert asked(1) == 1
        with pytest.raises(ZeroDivisionError):
            asked(0)


@pytest.mark.usefixtures("two_threads")
def test_values_and_gradients_are_those_of_all_at_once() -> None:
    torch.manual_seed(0)
    layers, x = Layers(), torch.randn(5, 3)

    def loss(values: tuple[Tensor, ...]) -> Tensor:
        return values[0].square().sum() + (values[1] * values[2][:, None]).sum()

    loss(layers(x)).backward()
    plain = {name: p.grad for name, p in layers.named_parameters()}
    layers.zero_grad()
    parts = [partial(layers, part) for part in x.split([2, 2, 1])]
    found = differentiable_parts(parts, list(layers.parameters()), CPU)
    for one, other in zip(found, layers(x), strict=True):
        torch.testing.assert_close(one, other)
    loss(found).backward()
    for name, parameter in layers.named_parameters():
        torch.testing.assert_close(parameter.grad, plain[name], msg=name)
    assert layers.idle.weight.grad is None, "what takes no part has no gradient, rather than one of nothing"


def test_an_error_in_a_part_is_raised() -> None:
    def failing() -> tuple[Tensor, ...]:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        differentiable_parts([failing], [], CPU)


def test_threads_make_each_shared_value_once_and_share_the_work() -> None:
    values: SharedValues[int, list[int]] = SharedValues(1000, len)
    made: list[tuple[int, int]] = []
    together = threading.Barrier(2, timeout=20)

    def make(key: int) -> list[int]:
        made.append((key, threading.get_ident()))
        together.wait()  # only passed if two threads make two values at the same time
        return [key]

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda _: values.get_all([1, 2, 3, 4], make), range(2)))
    assert found == [[[1], [2], [3], [4]]] * 2
    assert sorted(key for key, _ in made) == [1, 2, 3, 4]
    assert len({thread for _, thread in made}) == 2
    assert found[0][0] is found[1][0]


def test_shared_values_that_were_not_asked_for_for_the_longest_time_go_first() -> None:
    values: SharedValues[str, str] = SharedValues(10, len)
    made = []

    def make(key: str) -> str:
        made.append(key)
        return key

    for key in ("aaaa", "bbbb", "aaaa", "cc", "dd", "aaaa", "cc", "bbbb"):
        assert values.get(key, make) == key
    assert made == ["aaaa", "bbbb", "cc", "dd", "bbbb"]
    large = "e" * 20
    assert values.get(large, make) is values.get(large, make), "one value is kept, whatever its size"
    assert values.get("cc", make) == "cc"
    assert made[5:] == [large, "cc"]


def test_a_shared_value_that_could_not_be_made_is_tried_again() -> None:
    values: SharedValues[str, str] = SharedValues(10, len)

    tried = []

    def fail(key: str) -> str:
        tried.append(key)
        raise ValueError(key)

    with pytest.raises(ValueError, match="no"):
        values.get_all(["no", "yes"], fail)
    assert tried == ["no"], "an error is raised at once"
    assert values.get("no", str.upper) == "NO"


def batch_of(count: int, crop_px: int | None = 48):
    scene = wall.scene(wall.cameras(7, 96, 72, step=0.25), (3,))
    config = replace(SWIFT.train, tiles=count, tile_px=16, crop_px=crop_px)
    return draw_batch(scene, DepthPriors(scene), config, 3, torch.Generator().manual_seed(0))


def test_parts_of_a_batch_are_its_tiles_with_their_own_crops() -> None:
    batch = batch_of(3)
    parts = batch.parts(2)
    assert [len(part.targets) for part in parts] == [2, 1]
    for name in ("targets", "corner_px", "colours", "weight", "neighbours", "blend_weight"):
        torch.testing.assert_close(torch.cat([getattr(part, name) for part in parts]), getattr(batch, name))
    crops = [part.images[0][part.which] for part in parts]
    torch.testing.assert_close(torch.cat(crops), batch.images[0][batch.which])
    corners = [part.image_corner_px[0][part.which] for part in parts]
    torch.testing.assert_close(torch.cat(corners), batch.image_corner_px[0][batch.which])
    assert len(batch.parts(1)) == 1
    assert len(batch.parts(8)) == 3


def test_tiles_that_share_whole_photographs_stay_together() -> None:
    batch = batch_of(3, crop_px=None)
    assert batch.parts(2) == [batch]


@pytest.mark.usefixtures("two_threads")
def test_a_network_learns_from_parts_as_from_the_whole() -> None:
    """Up to rounding: matrices of other sizes are multiplied in another order."""
    scene = wall.scene(wall.cameras(7, 96, 72, step=0.25), (3,))
    torch.manual_seed(0)
    network = make_network(SWIFT.network)
    inputs = Inputs.draw(network, SWIFT.train, scene, DepthPriors(scene), 3, torch.Generator().manual_seed(1))
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        network.zero_grad()
        loss, error = BatchLoss(network, SWIFT.train)(inputs)
        loss.backward()
        gradient = torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])
        found.append((loss.detach(), error.detach(), gradient))
    (one, error, gradient), (other, other_error, other_gradient) = found
    torch.testing.assert_close(one, other, rtol=1e-3, atol=0)
    torch.testing.assert_close(error, other_error, rtol=1e-3, atol=0)
    assert (gradient - other_gradient).norm() < 0.02 * gradient.norm()
