"""The page of a scene while it is trained: what has been learned so far, for who looks."""

from __future__ import annotations

import copy
import time
from typing import TYPE_CHECKING, Any

from tidefield.geometry.cameras import Cameras
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Render, Rendering
from tidefield.recording import recording_lock
from tidefield.viewer.frames import SAMPLING
from tidefield.viewer.page import ScenePage

if TYPE_CHECKING:
    from tidefield.train.loop import Trainer

REFRESH_SECONDS = 20.0
"""Between two states of the network that are shown."""


class TrainingPage:
    """Shows a training; a callback of `tidefield.train.loop.train`.

    While nobody looks, a step costs one comparison. While somebody does, a copy of the network is rendered from now and
    then, in a thread of its own, and shares the cores with the training.

    Args:
        trainer: what is shown.
        name: of the run.
        host, port: where to listen.
    """

    def __init__(self, trainer: Trainer, name: str, host: str, port: int) -> None:
        self._kept: list[Renderer] = []
        self.page = ScenePage(trainer.scene, _as_it_is(trainer, self._kept), name, host, port)
        self._shown = time.monotonic()

    def __call__(self, trainer: Trainer, used: float) -> None:
        """Show the network as it is now, if somebody looks and it is time."""
        if not self.page.frames.viewers or time.monotonic() - self._shown < REFRESH_SECONDS:
            return
        self.page.frames.replace_method(_as_it_is(trainer, self._kept))
        self._shown = time.monotonic()

    def __enter__(self) -> TrainingPage:
        return self

    def __exit__(self, *error: Any) -> None:
        self.page.close()


def _as_it_is(trainer: Trainer, kept: list[Renderer] | None = None) -> Render:
    """A copy of what is trained, as a method; its renderer is made when the first picture is.

    Args:
        kept: the renderer of the copy before, which goes on with this one's network; the first one is put there.
    """
    from tidefield.train.loop import SceneTrainer

    still = copy.copy(trainer)
    still.network = copy.deepcopy(trainer.network).eval()
    if isinstance(still, SceneTrainer):
        still._open = still._ahead = None  # which the training would not give back otherwise
    earlier: list[Renderer] = [] if kept is None else kept
    made: list[Render] = []

    def render(camera: Cameras) -> Rendering:
        with recording_lock:  # the training goes on in another thread
            if not made and earlier and isinstance(still, SceneTrainer):
                earlier[0].renew(still.network)
                made.append(earlier[0])
            elif not made:
                made.append(still.renderer(SAMPLING))
                earlier.extend(one for one in made if isinstance(one, Renderer))
            return made[0](camera)

    return render
