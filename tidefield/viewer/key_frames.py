"""Camera paths from key frames: their editor in the page, and nerfstudio's file of them."""

from __future__ import annotations

import json
import math
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from tidefield.errors import TidefieldError
from tidefield.viewer.words import code

if TYPE_CHECKING:
    from viser import ClientHandle

FRAMES_PER_SECOND = 24.0
WIDTH, HEIGHT = 1280, 720
PREVIEW_FRAMES_PER_SECOND = 12.0
WRAPPED = 6
"""Key frames of a closed path that its orientations pass through again before its start and after its end."""


@dataclass(frozen=True)
class KeyFrame:
    """A camera of a path.

    Attributes:
        position_world: its centre.
        rotation: camera-to-world, OpenCV's axes.
        fov: vertical field of view, radians.
    """

    position_world: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    fov: float


def interpolate(keys: Sequence[KeyFrame], count: int, closed: bool = False) -> list[KeyFrame]:
    """Return the frames of a smooth path through key frames, which are evenly spaced in time.

    Positions and fields of view follow cubic splines, orientations a spline of rotations without jumps of the angular
    velocity.

    Args:
        keys: at least two.
        count: of frames; the first is the first key, the last is the last one, or of a closed path next to the first.
        closed: return to the first key.

    Raises:
        TidefieldError: there are fewer than two keys.
    """
    if len(keys) < 2:
        raise TidefieldError(f"the path has {len(keys)} key frames: expected two or more; add some")
    first, last = (-WRAPPED, len(keys) + WRAPPED) if closed else (0, len(keys) - 1)
    turns = range(first, last + 1)
    rotations = Rotation.from_matrix(np.stack([keys[k % len(keys)].rotation for k in turns]))
    keys = [*keys, keys[0]] if closed else list(keys)
    knots = np.arange(len(keys), dtype=np.float64)
    at = np.linspace(0, knots[-1], count, endpoint=not closed)
    ends = "periodic" if closed else "natural"
    position = CubicSpline(knots, np.stack([key.position_world for key in keys]), bc_type=ends)(at)
    fov = CubicSpline(knots, np.array([key.fov for key in keys]), bc_type=ends)(at)
    rotation = RotationSpline(turns, rotations)(at).as_matrix()
    narrowest, widest = math.radians(0.1), math.radians(170)
    return [
        KeyFrame(p, r, float(np.clip(f, narrowest, widest))) for p, r, f in zip(position, rotation, fov, strict=True)
    ]


def nerfstudio_path(
    frames: Sequence[KeyFrame], origin_world: Sequence[float], width: int, height: int, frames_per_second: float
) -> dict[str, Any]:
    """Describe a path as nerfstudio's viewer exports it, in the coordinates of the scene's files.

    Args:
        frames: of the video.
        origin_world: what was subtracted from the coordinates on disk (`Scene.origin_world`).
        width, height: of the video, pixels.
        frames_per_second: of the video.
    """
    poses = []
    for frame in frames:
        pose = np.eye(4)
        pose[:3, :3] = frame.rotation * (1.0, -1.0, -1.0)  # from OpenCV's to OpenGL's y and z
        pose[:3, 3] = frame.position_world + np.asarray(origin_world)
        poses.append(
            {"camera_to_world": pose.reshape(-1).tolist(), "fov": math.degrees(frame.fov), "aspect": width / height}
        )
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": frames_per_second,
        "seconds": len(frames) / frames_per_second,
        "camera_path": poses,
    }


def render_command(source: Sequence[str]) -> str:
    """The command that makes a video along a saved path; the first word of `source` is the run or scene."""
    return shlex.join(["tidefield", "render", source[0], "flight.mp4", *source[1:], "--path", "camera_path.json"])


class PathEditor:
    """The controls of a path: key frames, preview, and the file.

    Args:
        client: whose page it is.
        here: where its camera is.
        place: puts its camera somewhere.
        source: words of a command line that name what is shown.
        origin_world: of the scene.
    """

    def __init__(
        self,
        client: ClientHandle,
        here: Callable[[], KeyFrame],
        place: Callable[[KeyFrame], None],
        source: Sequence[str],
        origin_world: Sequence[float],
    ) -> None:
        self.client, self._here, self._place, self._source, self._origin = client, here, place, source, origin_world
        self.keys: list[KeyFrame] = []
        self._playing = False
        gui = client.gui
        self._text = gui.add_markdown("")
        gui.add_button("Add key frame").on_click(lambda _: self._change(self.keys.append, self._here()))
        gui.add_button("Remove the last").on_click(lambda _: self._change(lambda: self.keys and self.keys.pop()))
        gui.add_button("Remove all").on_click(lambda _: self._change(self.keys.clear))
        self._seconds = gui.add_slider("Seconds", 1.0, 120.0, 0.5, 10.0)
        self._closed = gui.add_checkbox("Closed", False)
        self._play = gui.add_button("Preview")
        self._play.on_click(lambda _: self._preview())
        gui.add_button("Save as nerfstudio's path").on_click(lambda _: self._save())
        self._change(lambda: None)

    def frames(self, frames_per_second: float) -> list[KeyFrame]:
        """The frames of the path as it is set."""
        count = max(2, round(self._seconds.value * frames_per_second))
        return interpolate(self.keys, count, self._closed.value)

    def _change(self, change: Callable[..., Any], *values: Any) -> None:
        change(*values)
        count = len(self.keys)
        self._text.content = f"{count} key frame{'' if count == 1 else 's'}" + (
            "" if count > 1 else ". Move the camera, and add two or more."
        )

    def _preview(self) -> None:
        """Move the camera along the path, in its own time; a second click stops."""
        if self._playing:
            self._playing = False
            return
        try:
            frames = self.frames(PREVIEW_FRAMES_PER_SECOND)
        except TidefieldError as error:
            self._text.content = f"**{error}**"
            return
        self._playing, self._play.label = True, "Stop"
        start = time.monotonic()
        for k, frame in enumerate(frames):
            if not self._playing:
                break
            self._place(frame)
            time.sleep(max(0.0, start + (k + 1) / PREVIEW_FRAMES_PER_SECOND - time.monotonic()))
        self._playing, self._play.label = False, "Preview"

    def _save(self) -> None:
        try:
            frames = self.frames(FRAMES_PER_SECOND)
        except TidefieldError as error:
            self._text.content = f"**{error}**"
            return
        path = nerfstudio_path(frames, self._origin, WIDTH, HEIGHT, FRAMES_PER_SECOND)
        content = json.dumps(path, allow_nan=False).encode()
        self.client.send_file_download("camera_path.json", content, save_immediately=True)
        command = render_command(self._source)
        self._text.content = f"{len(frames)} frames saved. Render them: {code(command)}"
