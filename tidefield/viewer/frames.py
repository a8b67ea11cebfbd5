"""Progressive pictures for several viewers: a coarse one at once, a sharp one when the camera rests.

One thread makes coarse pictures, one sharp ones. Whoever has waited longest is served first, and a viewer has one
camera only, its last: what it asked for before is forgotten, and a sharp picture that is being made of it is cancelled.
Sharp pictures wait while coarse ones are made, so that a viewer that moves is not held up by one that rests.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial

from tidefield.config import Sampling
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render, Rendering
from tidefield.parallel import interruptible
from tidefield.viewer.preview import ColouredPoints, points_of

log = logging.getLogger(__name__)

REST_SECONDS = 0.2
"""Time without motion after which a camera rests."""
SAMPLING = Sampling(rays_per_side=1)
"""Of sharp pictures: several rays per pixel, usual from far away, take several times as long."""
END_SECONDS = 10.0
"""Time limit for what is being made to end, when all is closed: some pieces of work take 3 s on two busy cores, and
PyTorch aborts a process that ends while a thread computes."""
COARSE_PX = 200
"""Width of coarse pictures."""
DEFECT = "This is a defect of the program: the terminal has the details."


@dataclass(frozen=True)
class Frame:
    """A picture for a viewer.

    Attributes:
        rendering: None where it failed.
        camera: whose view it is.
        sharp: whether it is the last one until the camera moves.
        seconds: from the question to the picture.
        error: why there is none.
    """

    rendering: Rendering | None
    camera: Cameras
    sharp: bool
    seconds: float
    error: str | None = None


class Cancelled(Exception):
    """The picture that is being made is not wanted any more."""


@dataclass
class _Viewer:
    show: Callable[[Frame], None]
    camera: Cameras
    serial: int = 0
    asked: float = 0.0
    since: float = 0.0
    """When it asked, or the method was replaced: pictures are counted from then."""
    wants_coarse: bool = True
    wants_sharp: bool = True
    last_coarse: float = 0.0
    last_sharp: float = 0.0
    seen: ColouredPoints | None = field(default=None, repr=False)
    showing: threading.Lock = field(default_factory=threading.Lock, repr=False)


class FrameServer:
    """Makes the pictures of all viewers of one scene.

    Args:
        coarse: a camera and what a sharp picture from nearby has shown, to a picture in a fraction of a second.
        render: the method.
        prepare: does a small part of the work that makes later coarse pictures faster, while somebody looks and
            nothing moves; returns whether there was any.
        rest_seconds: see `REST_SECONDS`.
    """

    def __init__(
        self,
        coarse: Callable[[Cameras, ColouredPoints | None], Rendering],
        render: Render,
        prepare: Callable[[], bool] = lambda: False,
        rest_seconds: float = REST_SECONDS,
    ) -> None:
        self._coarse, self._render, self._prepare, self._rest = coarse, render, prepare, rest_seconds
        self._may_prepare = True
        self._viewers: dict[Hashable, _Viewer] = {}
        self._changed = threading.Condition()
        self._closed, self._making_coarse, self._making_sharp = False, False, False
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._run_coarse, self._run_sharp)]
        for thread in self._threads:
            thread.start()

    def ask(self, who: Hashable, camera: Cameras, show: Callable[[Frame], None]) -> None:
        """Have the pictures of a camera made for a viewer, instead of what it asked for before.

        Args:
            who: the viewer.
            camera: a single camera, of the size of the sharp picture.
            show: called with each picture, from another thread.
        """
        with self._changed:
            viewer = self._viewers.setdefault(who, _Viewer(show, camera))
            viewer.show, viewer.camera, viewer.serial = show, camera, viewer.serial + 1
            viewer.asked = viewer.since = time.monotonic()
            viewer.wants_coarse = viewer.wants_sharp = True
            self._changed.notify_all()

    def leave(self, who: Hashable) -> None:
        """Forget a viewer, with what is kept or being made for it."""
        with self._changed:
            self._viewers.pop(who, None)
            self._changed.notify_all()

    def replace_method(self, render: Render) -> None:
        """Render with another method from now on, and every viewer's picture again."""
        with self._changed:
            self._render = render
            for viewer in self._viewers.values():
                viewer.wants_sharp, viewer.since = True, time.monotonic()
            self._changed.notify_all()

    @property
    def viewers(self) -> int:
        """How many viewers have pictures made."""
        return len(self._viewers)

    @property
    def busy(self) -> bool:
        """Whether a picture is being made."""
        return self._making_coarse or self._making_sharp

    def close(self) -> None:
        """Cancel what is being made and end the threads; what does not hear of it in time ends with the program."""
        with self._changed:
            self._closed = True
            self._viewers.clear()
            self._changed.notify_all()
        end = time.monotonic() + END_SECONDS
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))

    def _run_coarse(self) -> None:
        while True:
            with self._changed:
                work = self._next_work()
                while work is None and not self._closed:
                    self._changed.wait()
                    work = self._next_work()
                if work is None or self._closed:
                    return
            work()

    def _next_work(self) -> Callable[[], None] | None:
        """What the first thread does next: the coarse picture of who has waited longest, or prepare others."""
        waiting = self._waiting_for_coarse()
        if not waiting:
            return self._prepare_some if self._may_prepare and self._viewers else None
        who, viewer = min(waiting, key=lambda one: one[1].last_coarse)
        viewer.wants_coarse, self._making_coarse = False, True
        return partial(self._make_coarse, who, viewer, viewer.serial, viewer.camera, viewer.since, viewer.seen)

    def _prepare_some(self) -> None:
        try:
            self._may_prepare = self._prepare()
        except Exception:  # pictures are made without
            log.exception("coarse pictures could not be prepared")
            self._may_prepare, self._prepare = False, lambda: False

    def _make_coarse(
        self, who: Hashable, viewer: _Viewer, serial: int, camera: Cameras, since: float, seen: ColouredPoints | None
    ) -> None:
        try:
            height = max(1, round(camera.height * COARSE_PX / camera.width))
            small = camera.resized(COARSE_PX, height) if camera.width > COARSE_PX else camera
            frame = self._made(lambda: self._coarse(small, seen), small, False, since)
            self._show(who, viewer, frame, serial)
        finally:
            with self._changed:
                self._making_coarse, self._may_prepare = False, True
                viewer.last_coarse = time.monotonic()
                self._changed.notify_all()

    def _run_sharp(self) -> None:
        while True:
            with self._changed:
                found = self._rested()
                while found is None and not self._closed:
                    self._changed.wait(self._until_rest())
                    found = self._rested()
                if found is None or self._closed:
                    return
                who, viewer = found
                viewer.wants_sharp, self._making_sharp = False, True
                serial, camera, since, render = viewer.serial, viewer.camera, viewer.since, self._render

            def check(who: Hashable = who, viewer: _Viewer = viewer, serial: int = serial) -> None:
                """Cancel what is not wanted any more, and let coarse pictures go first."""
                with self._changed:
                    while True:
                        if self._closed or self._viewers.get(who) is not viewer or viewer.serial != serial:
                            raise Cancelled
                        if not self._making_coarse and not self._waiting_for_coarse():
                            return
                        self._changed.wait()

            try:
                with interruptible(check):
                    check()
                    frame = self._made(lambda render=render, camera=camera: render(camera), camera, True, since)
                check()
            except Cancelled:
                continue
            finally:
                self._making_sharp = False
            if frame.rendering is not None:
                viewer.seen = points_of(frame.rendering, camera)
            viewer.last_sharp = time.monotonic()
            self._show(who, viewer, frame, serial)

    def _waiting_for_coarse(self) -> list[tuple[Hashable, _Viewer]]:
        return [(who, viewer) for who, viewer in self._viewers.items() if viewer.wants_coarse]

    def _rested(self) -> tuple[Hashable, _Viewer] | None:
        """The viewer whose camera rests and who has waited longest for a sharp picture."""
        now = time.monotonic()
        resting = [
            (who, viewer)
            for who, viewer in self._viewers.items()
            if viewer.wants_sharp and not viewer.wants_coarse and now - viewer.asked >= self._rest
        ]
        return min(resting, key=lambda one: one[1].last_sharp) if resting and not self._making_coarse else None

    def _until_rest(self) -> float | None:
        """Seconds until the next camera may rest; None if no viewer waits."""
        waiting = [viewer.asked for viewer in self._viewers.values() if viewer.wants_sharp]
        return max(0.01, min(waiting) + self._rest - time.monotonic()) if waiting else None

    def _made(self, make: Callable[[], Rendering], camera: Cameras, sharp: bool, since: float) -> Frame:
        rendering, error = None, None
        try:
            rendering = make()
        except Cancelled:
            raise
        except TidefieldError as found:
            error = str(found)
        except Exception:
            if not self._closed:  # otherwise what it renders with may be gone already
                log.exception("a view could not be rendered")
            error = DEFECT
        return Frame(rendering, camera, sharp, time.monotonic() - since, error)

    def _show(self, who: Hashable, viewer: _Viewer, frame: Frame, serial: int) -> None:
        with viewer.showing:
            # A coarse picture of a camera that has moved on since is the newest that there is, a sharp one is not.
            if self._viewers.get(who) is not viewer or (frame.sharp and viewer.serial != serial):
                return
            try:
                viewer.show(frame)
            except Exception:  # the others' pictures go on
                log.exception("a picture could not be shown")
