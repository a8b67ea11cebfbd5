"""Pictures for several viewers: coarse first, sharp at rest, cancelled by motion, fair, forgotten with who leaves."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import textured_wall
import torch

from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering
from tidefield.parallel import check_interrupted, in_parallel
from tidefield.viewer import frames
from tidefield.viewer.frames import COARSE_PX, Frame, FrameServer

PATIENCE = 20.0


def camera(x: float = 0.0, width: int = 400) -> Cameras:
    one = textured_wall.cameras(1, width, 3 * width // 4)
    one.T_world_camera[0, 0, 3] = x
    return one


def grey(camera: Cameras, value: float = 0.5) -> Rendering:
    plane = torch.ones(camera.height, camera.width)
    return Rendering(colour=value * plane[..., None].expand(-1, -1, 3), depth=plane, opacity=plane)


class SlowMethod:
    """A method whose picture has pieces, made on all cores or one by one; each waits until it may go on."""

    def __init__(self, one_by_one: bool = False) -> None:
        self.one_by_one = one_by_one
        self.may_go = threading.Event()
        self.started, self.finished, self.pieces = 0, 0, 0

    def __call__(self, camera: Cameras) -> Rendering:
        self.started += 1

        def piece() -> int:
            self.pieces += 1
            self.may_go.wait(PATIENCE)
            return 0

        if self.one_by_one:
            for _ in range(50):
                check_interrupted()
                piece()
        else:
            in_parallel([piece] * 50, "cpu")
        self.finished += 1
        return grey(camera)


@contextmanager
def serving(method, coarse=lambda camera, seen: grey(camera), **options) -> Iterator[FrameServer]:
    server = FrameServer(coarse, method, rest_seconds=0.05, **options)
    try:
        yield server
    finally:
        if isinstance(method, SlowMethod):
            method.may_go.set()
        server.close()


class Shown(list[Frame]):
    """The frames of a viewer, which can be waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.changed = threading.Condition()

    def __call__(self, frame: Frame) -> None:
        with self.changed:
            self.append(frame)
            self.changed.notify_all()

    def wait_for(self, count: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self) >= count, PATIENCE), f"{len(self)} of {count} frames came"


def eventually(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


def test_a_coarse_picture_comes_first_and_a_sharp_one_follows():
    shown = Shown()
    with serving(grey) as server:
        server.ask("a", camera(), shown)
        shown.wait_for(2)
    assert [frame.sharp for frame in shown] == [False, True]
    assert shown[0].camera.width == COARSE_PX
    assert shown[1].camera.width == 400
    assert shown[1].rendering is not None
    assert shown[1].rendering.colour.shape == (300, 400, 3)


@pytest.mark.parametrize("one_by_one", [False, True])
def test_motion_cancels_the_sharp_picture_that_is_being_made(one_by_one: bool):
    method, shown = SlowMethod(one_by_one), Shown()
    with serving(method) as server:
        server.ask("a", camera(0.0), shown)
        eventually(lambda: method.pieces > 0)
        server.ask("a", camera(1.0), shown)
        method.may_go.set()
        shown.wait_for(3)
        assert method.started == 2
        assert method.finished == 1
    assert [frame.sharp for frame in shown] == [False, False, True]
    assert float(shown[2].camera.position_world[0, 0]) == 1.0


def test_while_one_viewer_waits_for_a_sharp_picture_another_moves():
    method, still, moving = SlowMethod(), Shown(), Shown()
    with serving(method) as server:
        server.ask("still", camera(), still)
        eventually(lambda: method.pieces > 0)
        for count in range(1, 4):
            server.ask("moving", camera(float(count)), moving)
            moving.wait_for(count)
        assert [frame.sharp for frame in still] == [False]
        assert not any(frame.sharp for frame in moving)


def test_viewers_that_all_move_get_as_many_coarse_pictures_each():
    counts, shown = dict.fromkeys("abc", 0), {who: Shown() for who in "abc"}

    def coarse(one: Cameras, seen: object) -> Rendering:
        time.sleep(0.01)
        return grey(one)

    with serving(grey, coarse) as server:

        def show(who: str):
            def again(frame: Frame) -> None:
                if frame.sharp:
                    return
                counts[who] += 1
                shown[who](frame)
                if counts[who] < 20:
                    server.ask(who, camera(float(counts[who])), show(who))

            return again

        for who in "abc":
            server.ask(who, camera(), show(who))
        shown["a"].wait_for(15)
        assert min(counts.values()) >= 12


def test_a_viewer_that_leaves_frees_its_work():
    method, shown = SlowMethod(), Shown()
    with serving(method) as server:
        server.ask("a", camera(), shown)
        eventually(lambda: method.pieces > 0)
        server.leave("a")
        assert server.viewers == 0
        method.may_go.set()
        eventually(lambda: not server.busy)
        assert method.finished == 0
        other = Shown()
        server.ask("b", camera(), other)
        other.wait_for(2)
        assert method.finished == 1
    assert [frame.sharp for frame in shown] == [False]


def test_an_error_is_shown_and_the_next_picture_is_made():
    fail = [True]

    def method(camera: Cameras) -> Rendering:
        if fail[0]:
            raise SceneError("no photograph is there: expected one; add it")
        return grey(camera)

    shown = Shown()
    with serving(method) as server:
        server.ask("a", camera(), shown)
        shown.wait_for(2)
        assert shown[1].rendering is None
        assert shown[1].error == "no photograph is there: expected one; add it"
        fail[0] = False
        server.ask("a", camera(), shown)
        shown.wait_for(4)
    assert shown[3].rendering is not None


def test_pictures_are_made_again_with_another_method():
    shown = Shown()
    with serving(lambda camera: grey(camera, 0.25)) as server:
        server.ask("a", camera(), shown)
        shown.wait_for(2)
        server.replace_method(lambda camera: grey(camera, 0.75))
        shown.wait_for(3)
    values = [float(frame.rendering.colour.mean()) for frame in shown if frame.rendering is not None]
    assert values == pytest.approx([0.5, 0.25, 0.75])


def test_a_picture_of_another_method_is_counted_from_when_that_came():
    shown = Shown()
    with serving(grey) as server:
        server.ask("a", camera(), shown)
        shown.wait_for(2)
        server._viewers["a"].since -= 100
        server.replace_method(grey)
        shown.wait_for(3)
    assert shown[2].seconds < PATIENCE


def test_a_sharp_picture_of_a_camera_that_has_moved_on_is_not_shown():
    shown = Shown()
    with serving(grey) as server:
        server.ask("a", camera(), shown)
        shown.wait_for(2)
        coarse, sharp = shown
        viewer = server._viewers["a"]
        for frame in (sharp, coarse):
            server._show("a", viewer, frame, viewer.serial - 1)
        assert list(shown) == [coarse, sharp, coarse]


def test_pictures_are_made_without_what_cannot_be_prepared(caplog: pytest.LogCaptureFixture):
    def prepare() -> bool:
        raise OSError("a photograph is damaged")

    shown = Shown()
    with serving(grey, prepare=prepare) as server:
        server.ask("before", camera(), Shown())
        eventually(lambda: "could not be prepared" in caplog.text)
        server.ask("a", camera(), shown)
        shown.wait_for(2)
    assert [frame.sharp for frame in shown] == [False, True]
    assert caplog.text.count("OSError: a photograph is damaged") == 1


def test_what_makes_coarse_pictures_faster_is_prepared_while_nothing_moves():
    left = [3]

    def prepare() -> bool:
        left[0] -= 1
        return left[0] > 0

    with serving(grey, prepare=prepare) as server:
        time.sleep(0.05)
        assert left[0] == 3, "nobody looks"
        server.ask("a", camera(), Shown())
        eventually(lambda: left[0] == 0)
        time.sleep(0.05)
        assert left[0] == 0


def test_closing_waits_for_no_method_that_does_not_hear_of_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(frames, "END_SECONDS", 0.1)
    started, may_go = threading.Event(), threading.Event()

    def method(camera: Cameras) -> Rendering:
        started.set()
        may_go.wait(PATIENCE)
        raise FileNotFoundError("what it renders with is gone")

    with serving(method) as server:
        server.ask("a", camera(), Shown())
        assert started.wait(PATIENCE)
        start = time.monotonic()
        server.close()
        assert time.monotonic() - start < PATIENCE / 4
        may_go.set()
        eventually(lambda: not server.busy)
    assert caplog.text == ""
