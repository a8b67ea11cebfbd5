"""`tidefield evaluate` and `tidefield render`: runs and scenes become figures, pictures and videos."""

from __future__ import annotations

from rich.console import Console

from tidefield.commands.opening import load, opened
from tidefield.errors import RunError, TidefieldError
from tidefield.evaluation.evaluate import Evaluation
from tidefield.evaluation.evaluate import evaluate as evaluate_method
from tidefield.evaluation.lpips import download_lpips_weights
from tidefield.files import refuse_existing
from tidefield.geometry.cameras import Cameras
from tidefield.methods import untrained
from tidefield.options import Evaluate, Render
from tidefield.progress import ProgressBar
from tidefield.render.camera_paths import make_trajectory
from tidefield.render.stills import write_still


def evaluate(options: Evaluate, console: Console) -> Evaluation:
    """See `tidefield evaluate --help`."""
    if options.download_lpips:
        download_lpips_weights()
    source, out, method = options.source, options.out, options.method
    settings = {"overwrite": options.overwrite, "console": console}
    if method is not None and options.zero.zero_shot:
        raise RunError("both --method and --zero-shot are given: expected one of them; leave one out")
    if out is None:
        if method is not None or options.zero.zero_shot:
            raise RunError(f"nowhere to write: expected `tidefield evaluate {source} OUT ...`; name a folder")
        out = source
    if method is not None:
        scene = load(source, options.width, options.allow_missing, console)
        return evaluate_method(untrained(method, scene), scene, out, configuration={"method": method}, **settings)
    with opened(options, console) as (scene, view, configuration):
        return evaluate_method(view, scene, out, configuration=configuration, **settings)


def render(options: Render, console: Console) -> None:
    """See `tidefield render --help`."""
    out, camera, overwrite = options.out, options.camera, options.overwrite
    wanted = ".mp4" if camera is None else ".png"
    if out.suffix.lower() != wanted:
        what = "a video" if camera is None else "one view (--camera)"
        raise RunError(f"{out.name} was asked for: {what} is written as {wanted}; change the name")
    if not overwrite:
        refuse_existing(out)
    with opened(options, console) as (scene, view, _):
        if camera is not None:
            own = scene.cameras[scene.index(camera)]
            size = _size(own, options.width, options.height)
            for file in write_still(view(own.resized(*size)), out, overwrite=overwrite):
                console.print(str(file), highlight=False, soft_wrap=True)
            return
        width, height = _size(scene.cameras[scene.train[0]], options.width, options.height)
        trajectory = make_trajectory(options.path, scene, frames=options.frames, width=width, height=height)
        cameras = trajectory.cameras
        from tidefield.render.video import write_video

        with ProgressBar(console, "Rendering") as meter:
            write_video(
                (view(cameras[k]) for k in range(len(cameras))),
                out,
                trajectory.frames_per_second,
                overwrite=overwrite,
                progress=lambda done: meter(done, len(cameras)),
            )
    console.print(f"{out}: {len(cameras)} frames", highlight=False, soft_wrap=True)


def _size(camera: Cameras, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of a picture: what is asked for, else the camera's, else in its proportion."""
    for name, value in (("width", width), ("height", height)):
        if value is not None and not 16 <= value <= 16384:
            raise TidefieldError(f"--{name} {value} was asked for: expected 16 to 16384 pixels; choose another")
    if width is None and height is None:
        return camera.width, camera.height
    if width is None:
        assert height is not None
        return max(16, round(height * camera.width / camera.height)), height
    return width, height if height is not None else max(16, round(width * camera.height / camera.width))
