"""The page of a scene in a real browser: it opens, the camera moves, the picture sharpens, a path is saved."""

import io
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import textured_wall
import torch
from browser import open_browser
from jaxtyping import Float64
from PIL import Image

from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering
from tidefield.render.camera_paths import make_trajectory
from tidefield.viewer.frames import Frame, FrameServer
from tidefield.viewer.page import ScenePage, _Client
from tidefield.viewer.ports import page_address, require_port

pytest.importorskip("viser", reason="needs viser, which is not installed")
SCREENSHOTS = os.environ.get("TIDEFIELD_SCREENSHOTS")
"""A folder to keep the screenshots in, for people to look at."""


def settled(tab, name: str) -> Float64[np.ndarray, "H W 3"]:
    """What a tab shows once that stays the same: a busy machine moves late, and glides."""
    before, shown = None, picture_of(tab, name)
    for _ in range(60):
        if before is not None and np.abs(shown - before).mean() < 0.1:
            break
        tab.wait_for_timeout(1000)
        before, shown = shown, picture_of(tab, name)
    return shown


def wall() -> Scene:
    return textured_wall.scene(textured_wall.cameras(6, 96, 72))


def render_wall(camera: Cameras) -> Rendering:
    """The wall as it is, wherever the camera is in front of it."""
    colour = textured_wall.photograph(camera).float() / 255
    return Rendering(colour, textured_wall.true_depth(camera), torch.ones(camera.height, camera.width))


@contextmanager
def page_of(scene: Scene) -> Iterator[ScenePage]:
    page = ScenePage(scene, render_wall, "wall", "127.0.0.1", 0, 400)
    try:
        yield page
    finally:
        page.close()


def picture_of(tab, name: str) -> Float64[np.ndarray, "H W 3"]:
    """What a tab shows, left of its controls."""
    content = tab.screenshot()
    if SCREENSHOTS:
        Path(SCREENSHOTS, f"{name}.png").write_bytes(content)
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), dtype=np.float64)[200:500, 100:450]


def sharpness(picture: Float64[np.ndarray, "H W 3"]) -> float:
    """Mean absolute difference of neighbouring pixels."""
    return float(np.abs(np.diff(picture, axis=0)).mean() + np.abs(np.diff(picture, axis=1)).mean())


@pytest.mark.thorough
def test_the_camera_moves_the_picture_sharpens_and_a_path_is_saved_and_read(tmp_path: Path):
    scene = wall()
    with page_of(scene) as page, open_browser() as browser:
        tab = browser.new_page(viewport={"width": 900, "height": 600})
        foreign: list[str] = []
        tab.on("request", lambda request: foreign.append(request.url))
        tab.goto(page.address)
        tab.get_by_text("sharp,").wait_for()
        tab.get_by_text("Photographs", exact=True).click()
        tab.wait_for_timeout(500)
        first = picture_of(tab, "first")
        assert sharpness(first) > 1, "nothing is shown"
        tab.get_by_text("Path", exact=True).click()
        tab.get_by_role("button", name="Add key frame").click()
        tab.get_by_text("1 key frame").wait_for()

        tab.mouse.move(300, 300)
        tab.mouse.down(button="right")
        tab.mouse.move(420, 330, steps=4)
        tab.mouse.up(button="right")
        tab.wait_for_timeout(1500)
        moved = settled(tab, "moved")
        assert np.abs(moved - first).mean() > 5, "the picture did not change"

        tab.get_by_role("button", name="Add key frame").click()
        tab.get_by_text("2 key frames").wait_for()
        with tab.expect_download() as download:
            tab.get_by_role("button", name="Save as nerfstudio's path").click()
        download.value.save_as(tmp_path / "camera_path.json")
        tab.get_by_text("View", exact=True).click()
        tab.get_by_role("button", name="Address of this view").click()
        address = tab.get_by_role("link", name="This view").get_attribute("href")
        again = browser.new_page(viewport={"width": 900, "height": 600})
        again.goto(page.address + re.sub(r"^[^?]*", "", address))
        again.get_by_text("sharp,").wait_for()
        again.get_by_text("Photographs", exact=True).click()
        again.wait_for_timeout(500)
        returned = settled(again, "address")
        assert np.abs(returned - moved).mean() < 0.3 * np.abs(first - moved).mean(), "the address shows another view"
        outside = [url for url in foreign if not url.startswith((page.address, "data:", "blob:"))]
        assert outside == []
        tab.close()
        again.close()
    cameras = make_trajectory(str(tmp_path / "camera_path.json"), scene, frames=1, width=1, height=1).cameras
    assert len(cameras) == 240
    assert (cameras.width, cameras.height) == (1280, 720)
    way = cameras.position_world[-1] - cameras.position_world[0]
    assert float(way.norm()) > 0.1
    view = render_wall(cameras[120].resized(64, 36))
    assert view.colour.shape == (36, 64, 3)


@pytest.mark.thorough
def test_a_picture_that_rests_is_sharper_than_the_first_one():
    with page_of(wall()) as page, ExitStack() as stack, open_browser() as browser:
        may_render, make = threading.Event(), page.frames._render
        stack.callback(may_render.set)  # else a test that fails before would wait for the renderer for ever

        def wait_then_render(camera: Cameras) -> Rendering:
            while not may_render.wait(0.01):
                torch.ones(1).sum()  # where what nobody looks at any more is cancelled
            return make(camera)

        page.frames.replace_method(wait_then_render)
        tab = browser.new_page(viewport={"width": 900, "height": 600})
        tab.goto(page.address)
        tab.get_by_text("coarse").wait_for()
        tab.get_by_text("Photographs", exact=True).click()
        tab.wait_for_timeout(500)
        coarse = picture_of(tab, "coarse")
        may_render.set()
        tab.get_by_text("sharp,").wait_for()
        tab.wait_for_timeout(500)
        sharp = picture_of(tab, "sharp")
        (viewer,) = page.frames._viewers.values()
        true = render_wall(viewer.camera.resized(900, 600)).colour.double().numpy()[200:500, 100:450] * 255
        assert np.abs(sharp - true).mean() < 0.5 * np.abs(coarse - true).mean()
        tab.close()


def test_a_port_in_use_is_one_clear_error():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(RunError, match=rf"port {port} of 127\.0\.0\.1 cannot be listened on .*choose another"):
            require_port("127.0.0.1", port)


def client_of(page: object, **own: object) -> _Client:
    """What a browser shows, without its controls."""
    client = _Client.__new__(_Client)
    locks = {"_asking": threading.Lock(), "_drawing": threading.Lock()}
    vars(client).update(page=page, _moves=0, _each={}, **locks, **own)
    return client


def test_of_moves_that_wait_only_the_last_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    reading, may_go, asked = threading.Event(), threading.Event(), []

    def read(_: _Client) -> int:
        own = client._moves
        reading.set()
        assert may_go.wait(20)
        return own

    monkeypatch.setattr(_Client, "camera", read)
    browser = SimpleNamespace(client_id=3, camera=SimpleNamespace(image_width=8, image_height=6, position=np.zeros(3)))
    frames = SimpleNamespace(ask=lambda who, camera, show: asked.append(camera))
    server = SimpleNamespace(get_clients=lambda: {3: browser})
    page = SimpleNamespace(frames=frames, server=server, positions=np.zeros((0, 3)))
    client = client_of(page, client=browser)
    moves = [threading.Thread(target=client.moved) for _ in range(6)]
    moves[0].start()
    assert reading.wait(20)
    for move in moves[1:]:
        move.start()
    while client._moves < len(moves):
        time.sleep(0.001)
    may_go.set()
    for move in moves:
        move.join(20)
    assert asked == [1, 6]


def test_an_error_is_shown_as_it_is_without_the_scenes_place(tmp_path: Path):
    scene = SimpleNamespace(root=tmp_path / "flat_2024")
    client = client_of(SimpleNamespace(scene=scene), status=SimpleNamespace(content=""))
    words = f"{scene.root / 'DJI_1_.JPG'} cannot be read"
    client._show(Frame(None, wall().cameras[0], True, 0.0, words))
    assert client.status.content == r"**No picture:** flat\_2024\/DJI\_1\_\.JPG cannot be read"


def test_a_photograph_is_read_for_the_first_browser_only():
    read = []

    def photograph(index: int) -> torch.Tensor:
        read.append(index)
        return torch.zeros(300, 400, 3, dtype=torch.uint8)

    class Photographs:
        def __getitem__(self, index: int) -> torch.Tensor:
            return photograph(index)

    page = ScenePage.__new__(ScenePage)
    vars(page).update(scene=SimpleNamespace(photographs=Photographs()), _thumbnails={})
    assert page.thumbnail(2).shape == page.thumbnail(2).shape == (75, 100, 3)
    assert read == [2]


def test_names_that_are_not_utf_8_are_offered_and_flown_to(monkeypatch: pytest.MonkeyPatch):
    scene = wall()
    odd = b"caf\xe9.jpg".decode("utf-8", "surrogateescape")
    scene = replace(scene, names=(odd, *scene.names[1:]))
    flown: list[str] = []
    monkeypatch.setattr(_Client, "fly_to_photograph", lambda _, name: flown.append(name))
    with page_of(scene) as page:
        from viser import GuiApi

        made: dict[str, object] = {}
        for kind in ("add_dropdown", "add_button"):
            usual = getattr(GuiApi, kind)

            def add(gui: GuiApi, label: str, *values: object, usual=usual, **options: object) -> object:
                made[label] = usual(gui, label, *values, **options)
                return made[label]

            monkeypatch.setattr(GuiApi, kind, add)
        server = page.server
        client = SimpleNamespace(gui=server.gui, scene=server.scene, client_id=1, camera=None)
        _Client(page, client)
        made["Photograph"].value.encode()
        (fly,) = made["Fly there"]._impl.update_cb
        fly(None)
    assert flown == [odd]


@pytest.mark.parametrize("stays", [True, False])
def test_a_browser_that_leaves_while_its_page_is_set_up_is_no_viewer(stays: bool, monkeypatch: pytest.MonkeyPatch):
    camera = wall().cameras[0]
    monkeypatch.setattr(_Client, "camera", lambda _: camera)
    browser = SimpleNamespace(client_id=3, camera=SimpleNamespace(image_width=8, image_height=6, position=np.zeros(3)))
    frames = FrameServer(lambda one, seen: render_wall(one), render_wall)
    page = SimpleNamespace(frames=frames, server=SimpleNamespace(), positions=np.zeros((0, 3)))
    client = client_of(page, client=browser, _show=lambda _: None)
    page.server.get_clients = lambda: {3: browser} if stays else {}
    client.moved()
    assert frames.viewers == stays
    frames.close()


def test_a_host_of_either_family_has_an_address_that_browsers_read():
    assert page_address("::1", 8080) == "http://[::1]:8080"
    assert page_address("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert page_address("::", 1) == page_address("0.0.0.0", 1) == "http://localhost:1"


def test_on_windows_a_port_in_use_is_not_shared(monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []
    monkeypatch.setattr("tidefield.viewer.ports.sys.platform", "win32")
    monkeypatch.setattr(socket, "SO_EXCLUSIVEADDRUSE", -5, raising=False)
    monkeypatch.setattr(socket.socket, "setsockopt", lambda _, level, option, value: asked.append(option))
    require_port("127.0.0.1", 0)
    assert asked == [-5]
