"""`tidefield view`: look at a run, a scene or maps in a browser."""

from __future__ import annotations

import logging
import os
import threading
import webbrowser
from contextlib import ExitStack
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Device, Verbosity, ZeroShot, open_source
from tidefield.errors import RunError, need

if TYPE_CHECKING:
    from rich.console import Console

log = logging.getLogger(__name__)
_OF_SCENES = ("width", "device", "allow_missing")
"""Options that maps have no use for."""


@dataclass(frozen=True)
class View:
    """Look at a run, a scene or maps in a browser.

    Of a run, or with --zero-shot of a scene: a free camera, photographs, points and camera paths. A coarse picture is
    there at once, a sharp one when the camera rests. Of maps and changes: layers, heights with their errors, ruler,
    areas with volumes, sections, and two dates side by side. Only this machine can see the page, unless --host says
    otherwise. Ctrl-C ends it.
    """

    sources: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|SCENE|MAP ...")]
    """A trained run; with --zero-shot a scene; or folders of `tidefield map`, ODM and `tidefield change`, which are
    shown together from straight above."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    width: int = 800
    """Width of sharp pictures in pixels, at most."""
    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0 shows the photographs and all that is made of them to whoever reaches this machine
    over the network."""
    port: int = 8080
    """Port to listen on; 0 for any that is free."""
    no_browser: bool = False
    """Only print the address, open no browser."""
    device: Device = "auto"
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def view(options: View, console: Console) -> None:
    """Run `tidefield view`."""
    from tidefield.device import choose_device
    from tidefield.viewer.ports import require_port

    if not 64 <= options.width <= 4096:
        raise RunError(f"--width {options.width} was asked for: expected 64 to 4096 pixels; choose another")
    require_port(options.host, options.port)
    if not options.sources:
        raise RunError("nothing to look at was named: expected a run, a scene with --zero-shot, or maps; name one")
    if not options.zero.checked().zero_shot and _are_maps(options.sources):
        _view_maps(options, console)
        return
    from tidefield.viewer.frames import SAMPLING
    from tidefield.viewer.page import ScenePage

    need("viser", "view")
    source = options.sources[0]
    if len(options.sources) > 1:
        raise RunError(f"{len(options.sources)} scenes were named: expected one at a time; leave the others out")
    device = choose_device(options.device)
    if not options.zero.zero_shot:
        _require_trained(source)
    with ExitStack() as stack:
        opened = open_source(source, options.zero, device, options.allow_missing, console, SAMPLING)
        scene, render, _ = stack.enter_context(opened)
        name = source.resolve().name
        words = [name, *options.zero.words]
        page = ScenePage(scene, render, name, options.host, options.port, options.width, words)
        stack.callback(page.close)
        serve(page.address, options.host, options.no_browser, console)


def _are_maps(sources: tuple[Path, ...]) -> bool:
    """Whether maps are to be shown, rather than a run or a scene.

    Raises:
        RunError: there are several sources, and one of them is no map.
    """
    from tidefield.viewer.sheets import is_sheet

    maps = [is_sheet(source) for source in sources]
    if len(sources) == 1 or all(maps):
        return maps[0]
    other = sources[maps.index(False)]
    raise RunError(
        f"{other} is no folder of `tidefield map`, ODM or `tidefield change`: expected several of these, or one run or "
        "scene; leave it out"
    )


def _view_maps(options: View, console: Console) -> None:
    of_scenes = {field.name: field.default for field in fields(View) if field.name in _OF_SCENES}
    given = next((name for name, usual in of_scenes.items() if getattr(options, name) != usual), None)
    if given is not None:
        raise RunError(f"--{given.replace('_', '-')} was given with maps: it belongs to runs and scenes; leave it out")
    from tidefield.change.surfaces import other_datums
    from tidefield.viewer.atlas import Atlas
    from tidefield.viewer.map_page import MapPage

    atlas = Atlas(options.sources)
    surfaces = [(sheet.title, sheet.heights) for sheet in atlas.sheets if sheet.heights is not None]
    for title, heights in surfaces:
        for remark in heights.remarks:
            log.warning(f"{title}: {remark}")
    for (title, heights), (other_title, other) in combinations(surfaces, 2):
        if datums := other_datums(heights, other):
            log.warning(f"{title} and {other_title}: {datums}; sections and differences between them include that")
    page = MapPage(atlas, options.host, options.port)
    try:
        serve(page.address, options.host, options.no_browser, console)
    finally:
        page.close()


def serve(address: str, host: str, no_browser: bool, console: Console) -> None:
    """Print where a page is, open a browser, and wait for Ctrl-C."""
    from tidefield.viewer.ports import LOCAL_HOSTS

    console.print(f"{address}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
    if host not in LOCAL_HOSTS:
        log.warning(
            f"listening on {host}: whoever reaches this machine over the network sees the photographs and all that is "
            "made of them"
        )
    if not no_browser and not _open_browser(address):
        log.warning(f"no browser could be opened: open {address} in one, on this machine")
    ended = threading.Event()
    try:
        while not ended.wait(1.0):  # on Windows, Ctrl-C does not interrupt a wait without a timeout
            pass
    except KeyboardInterrupt as error:
        if type(error) is not KeyboardInterrupt:  # a signal of the system's, with its own exit status
            raise
        console.print("ended")


def _open_browser(address: str) -> bool:
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


def _require_trained(folder: Path) -> None:
    """Raises: RunError when a folder is nothing that can be shown, or a run that has saved nothing yet."""
    from tidefield.data.load import is_scene
    from tidefield.files import is_locked
    from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE

    if not os.path.exists(folder / RUN_FILE):
        if is_scene(folder):
            return  # `open_source` says what to do
        found = "is no run or map" if os.path.exists(folder) else "does not exist"
        raise RunError(
            f"{folder} {found}: expected a run, a folder of `tidefield map`, ODM or `tidefield change`, or with "
            "--zero-shot a scene; name one"
        )
    if not is_locked(folder):
        return
    if not os.path.exists(folder / CHECKPOINT_FILE):
        raise RunError(
            f"{folder} is being trained and has saved nothing yet: expected a first checkpoint, a minute after its "
            "start; wait, or train with --view"
        )
    log.warning(f"{folder} is being trained: this shows what it last saved")
