"""`tidefield render`: views and videos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Cluster, Device, Footprint, Verbosity, ZeroShot, open_source
from tidefield.errors import RunError, TidefieldError
from tidefield.files import require_writable

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from tidefield.data.scene import Scene
    from tidefield.geometry.cameras import Cameras

FRAMES = 240
"""Of a video for which no number is given."""
FRAMES_AT_ONCE = 8
"""Frames of a task on a cluster: frames that follow each other read the same encoded photographs."""


@dataclass(frozen=True)
class Render:
    """Render a video along a camera path (OUT.mp4), or the view of one photograph's camera (OUT.png).

    A view comes with its depth: OUT_depth.npy has the z-depth of each pixel, float32, in the scene's units (metres
    where it is georeferenced), and NaN where no surface is; OUT_depth.png shows it, red near and blue far. The text
    fields of both PNGs tell the software, the scene's name, the photograph, and the camera with its pose.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A trained run, or with --zero-shot a scene."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """The file to write; .mp4 for a video, .png with --camera."""
    path: str | None = None
    """orbit (also if not given), cameras (a flight past the photographs), strip (straight down) or a camera path of
    nerfstudio's viewer (JSON)."""
    camera: str | None = None
    """Name of a photograph whose camera is rendered instead of a path."""
    with_itself: bool = False
    """With --camera, let a training photograph serve as a neighbour of its own view, which then hardly differs from it;
    without, its view is made from the others, as that of a held-out photograph."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    footprint: OmitArgPrefixes[Footprint] = Footprint()
    frames: int | None = None
    """Frames of the video, 24 a second; 240 if not given. A JSON has its own."""
    width: int | None = None
    """Width of the picture in pixels; that of the JSON or of the run's photographs if not given."""
    height: int | None = None
    """Height of the picture in pixels; in proportion to the width if not given."""
    device: Device = "auto"
    cluster: Cluster = None
    overwrite: bool = False
    """Replace existing files."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def render(options: Render, console: Console) -> None:
    """Run `tidefield render`."""
    from tidefield.cluster import connected
    from tidefield.device import choose_device
    from tidefield.progress import ProgressBar
    from tidefield.render.stills import describe_view, still_files, title, write_still

    out, camera, overwrite = options.out, options.camera, options.overwrite
    suffix = ".mp4" if camera is None else ".png"
    if out.suffix.lower() != suffix:
        what = "a video" if camera is None else "one view (--camera)"
        instead = ", or name the view of a photograph with --camera" if camera is None else ""
        raise RunError(f"{out.name} was asked for: {what} is written as {suffix}; change the name{instead}")
    if options.with_itself and camera is None:
        raise RunError("--with-itself belongs to --camera NAME: a path has no photographs of its own; leave it out")
    of_paths = next((name for name in ("path", "frames") if getattr(options, name) is not None), None)
    if of_paths is not None and camera is not None:
        raise RunError(f"--{of_paths} belongs to a video: --camera NAME is one view; leave one of them out")
    if options.frames is not None and options.path is not None and Path(options.path).suffix.lower() == ".json":
        raise RunError(f"--frames was given, but {Path(options.path).name} has frames of its own; leave it out")
    if options.cluster is not None and camera is not None:
        raise RunError("--cluster shares the frames of a path among machines: --camera NAME is one view; leave it out")
    require_writable(*([out] if camera is None else still_files(out)), overwrite=overwrite)
    for name, value in (("width", options.width), ("height", options.height)):
        if value is not None and not 16 <= value <= 16384:
            raise TidefieldError(f"--{name} {value} was asked for: expected 16 to 16384 pixels; choose another")
    path, count = options.path or "orbit", FRAMES if options.frames is None else options.frames
    if camera is None:
        from tidefield.render.camera_paths import require_path

        require_path(path, count)  # before photographs are read, which may take minutes
    device, sampling = choose_device(options.device), options.footprint.sampling
    opened = open_source(options.source, options.zero, device, options.allow_missing, console, sampling)
    with opened as (scene, view, record):
        if camera is not None:
            own = scene.cameras[scene.index(camera)]
            own = _resized(own, options.width, options.height)
            made = view(replace(own, names=()) if options.with_itself else own)
            for file in write_still(made, out, about=describe_view(scene, own), overwrite=overwrite):
                console.print(str(file), highlight=False, soft_wrap=True)
            return
        width, height = _size(scene.cameras[_usual(scene)], options.width, options.height)
        from tidefield.model.renderer import in_turn
        from tidefield.render.camera_paths import make_trajectory
        from tidefield.render.video import write_video

        trajectory = make_trajectory(path, scene, frames=count, width=width, height=height)
        cameras = _resized(trajectory.cameras, options.width, options.height)

        with ExitStack() as stack:
            bar = stack.enter_context(ProgressBar(console, "Rendering"))
            if options.cluster is None:
                frames = in_turn(view, cameras)
            else:
                ray = stack.enter_context(connected(options.cluster))
                frames = _frames_of_cluster(ray, options, cameras, _key(scene, record))
            write_video(
                frames,
                out,
                trajectory.frames_per_second,
                title=title(scene, Path(path).name),
                overwrite=overwrite,
                progress=lambda done: bar(done, len(cameras)),
            )
    console.print(f"{out}: {len(cameras)} frames", highlight=False, soft_wrap=True)


def _usual(scene: Scene) -> int:
    """A training photograph of the most frequent size: one may be upright, or a thumbnail."""
    sizes = {i: tuple(scene.cameras.size_px[i].tolist()) for i in scene.train}
    [(most, _)] = Counter(sizes.values()).most_common(1)
    return next(i for i, size in sizes.items() if size == most)


def _resized(cameras: Cameras, width: int | None, height: int | None) -> Cameras:
    """Cameras in a size in their own proportion, if one is given."""
    own, size = cameras[0], _size(cameras[0], width, height)
    if width and height and abs(size[0] * own.height - size[1] * own.width) > max(own.width, own.height):
        raise RunError(
            f"--width {width} --height {height} was given for views of {own.width} x {own.height} pixels: expected "
            "the same proportion; leave one of them out"
        )
    return cameras.resized(*size)


def _size(camera: Cameras, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of a picture: the given ones, else in the camera's proportion, else the camera's."""
    if width is None and height is None:
        return camera.width, camera.height
    if width is None:
        assert height is not None
        return max(16, round(height * camera.width / camera.height)), height
    return width, height if height is not None else max(16, round(width * camera.height / camera.width))


def _frames_of_cluster(ray: Any, options: Render, cameras: Cameras, key: str) -> Iterator[np.ndarray]:
    """Render the frames of a path on a cluster; 8-bit pictures in their order."""
    from tidefield.cluster import absolute, on_cluster, share_of

    count = len(cameras)
    parts = [range(first, min(first + FRAMES_AT_ONCE, count)) for first in range(0, count, FRAMES_AT_ONCE)]
    prepare = partial(_frame_maker, absolute(options), cameras, key)
    for _, pictures in on_cluster(ray, key, prepare, parts, share_of(ray, options.device, "gpu"), in_order=True):
        yield from pictures


@contextmanager
def _frame_maker(options: Render, cameras: Cameras, key: str) -> Iterator[Callable[[range], np.ndarray]]:
    """Open a scene in a worker of a cluster; a function from numbers of frames to their pictures."""
    import numpy as np
    import torch

    from tidefield.addresses import pull_all
    from tidefield.cluster import require_same
    from tidefield.device import choose_device
    from tidefield.progress import make_console
    from tidefield.render.stills import colour_picture

    torch.set_num_threads(1)  # a task has one core
    pull_all(options)
    device, console = choose_device(options.device), make_console(quiet=True)
    opened = open_source(
        options.source, options.zero, device, options.allow_missing, console, options.footprint.sampling
    )
    with opened as (scene, view, record):
        require_same(options.source, key, _key(scene, record))
        yield lambda numbers: np.stack([colour_picture(view(cameras[k])) for k in numbers])


def _key(scene: Scene, record: dict[str, Any]) -> str:
    """Identifies what frames are rendered from."""
    from tidefield.data.cache import key

    return key([list(scene.names), scene.cameras.T_world_camera.tolist(), scene.cameras.size_px.tolist(), record])
