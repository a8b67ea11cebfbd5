"""The page of maps in a real browser: ruler, swipe, dates, detection, address; and what its server refuses."""

import http.client
import io
import json
import logging
import os
import re
import socket
import struct
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import open_browser
from PIL import Image

pytest.importorskip("rasterio", reason="needs rasterio, which is not installed")

from map_folders import CELL, SHAPE, corner, write_change, write_map
from surveys_of_two_dates import write_surface

from tidefield.maps.grid import LOCAL_WKT
from tidefield.viewer.atlas import Atlas
from tidefield.viewer.map_page import MapPage, _Handler, _Server

SCREENSHOTS = os.environ.get("TIDEFIELD_SCREENSHOTS")
SIZE = {"width": 900, "height": 700}


@contextmanager
def page_of(*folders: Path) -> Iterator[MapPage]:
    page = MapPage(Atlas(folders), "127.0.0.1", 0)
    try:
        yield page
    finally:
        page.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with open_browser(webgl=False) as opened:
        yield opened


def two_dates(folder: Path) -> tuple[Path, Path]:
    return write_map(folder / "flat 2023-05-01", (200, 30, 30)), write_map(folder / "flat 2024-05-03", (30, 30, 200))


def colours(tab, name: str) -> np.ndarray:
    """The page's pixels once all tiles are there."""
    tab.locator('#map[aria-busy="false"]').wait_for()
    content = tab.screenshot()
    if SCREENSHOTS:
        Path(SCREENSHOTS, f"{name}.png").write_bytes(content)
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def pixel_of(tab, place: tuple[float, float]) -> tuple[float, float]:
    """Where the page shows a place, by the address."""
    tab.wait_for_url(re.compile("#x="))
    x, y, s = (float(re.search(rf"[#&]{k}=([^&]*)", tab.evaluate("location.hash")).group(1)) for k in "xys")
    return SIZE["width"] / 2 + (place[0] - x) / s, SIZE["height"] / 2 - (place[1] - y) / s


def test_the_ruler_between_two_points_gives_their_distance_within_a_pixel_on_the_ground(tmp_path: Path, browser):
    first, last = corner(20, 20), corner(80, 60)
    with page_of(write_map(tmp_path / "map", (90, 120, 60))) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.address)
        tab.get_by_role("button", name="Ruler").click()
        for place in (first, last):
            tab.mouse.click(*pixel_of(tab, place))
        words = tab.get_by_text("Distance").inner_text()
        tab.get_by_text("m up").wait_for()
        rise = float(re.search(r"([+-][\d.]+) m up", tab.locator("#result").inner_text()).group(1))
        scale = float(re.search(r"[#&]s=([^&]*)", tab.evaluate("location.hash")).group(1))
        colours(tab, "ruler")
        tab.close()
    found = float(re.search(r"([\d.]+) m", words).group(1))
    assert abs(found - np.hypot(30, 20)) < scale
    assert rise == pytest.approx(0.01 * 60 + 0.02 * 40, abs=0.04)


def test_the_swipe_shows_both_dates_the_slider_changes_them_and_the_address_brings_them_back(tmp_path: Path, browser):
    with page_of(*two_dates(tmp_path)) as page:
        tab = browser.new_page(viewport=SIZE)
        errors: list[str] = []
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(page.address)
        tab.get_by_label("Swipe").check()
        picture = colours(tab, "swipe")
        assert tuple(picture[300, 300]) == (200, 30, 30)
        assert tuple(picture[300, 600]) == (30, 30, 200)
        tab.mouse.move(450, 350)
        tab.mouse.down()
        tab.mouse.move(700, 350, steps=3)
        tab.mouse.up()
        tab.wait_for_url(re.compile("swipe=0.7"))
        assert tuple(colours(tab, "swiped")[300, 600]) == (200, 30, 30)
        again = browser.new_page(viewport=SIZE)
        again.goto(page.address + "/" + tab.evaluate("location.hash"))
        assert np.abs(colours(again, "again") - colours(tab, "swiped"))[100:500].mean() < 1
        again.get_by_label("Swipe").uncheck()
        again.get_by_label("Date").fill("1")
        assert tuple(colours(again, "later")[300, 300]) == (30, 30, 200)
        assert errors == []
        tab.close()
        again.close()


def test_what_is_measured_on_a_map_without_a_georeference_is_in_units(tmp_path: Path, browser):
    folder = tmp_path / "map"
    write_surface(folder / "odm_dem" / "dsm.tif", 1 + np.eye(*SHAPE, dtype=np.float32), CELL, crs=LOCAL_WKT)
    with page_of(folder) as page:
        tab = browser.new_page(viewport=SIZE)
        found = {}
        for tool, places in (("ruler", 2), ("section", 2), ("area", 3)):
            points = ";".join("{:.3f},{:.3f}".format(*corner(*at)) for at in ((60, 30), (75, 30), (75, 45))[:places])
            tab.goto("about:blank")
            tab.goto(f"{page.address}/#tool={tool}&points={points}")
            tab.locator('#result[aria-busy="false"]').wait_for()
            found[tool] = tab.locator("#result").inner_text()
        tab.close()
    assert re.search(r"^Distance 7.50 units\s", found["ruler"])
    assert "units up" in found["ruler"]
    assert found["section"].startswith("Section of 7.50 units")
    assert re.search(r"^Area 28.1 square units\s", found["area"])
    assert re.search(r"[\d.]+ cubic units", found["area"])


@pytest.mark.thorough
def test_what_is_measured_on_a_scene_a_few_units_wide_is_not_rounded_away(tmp_path: Path, browser):
    rows, columns = np.indices(SHAPE)
    heap = 0.02 * np.exp(-((rows - 40) ** 2 + (columns - 50) ** 2) / 50)
    write_surface(tmp_path / "odm_dem" / "dsm.tif", (2 + heap).astype(np.float32), 0.002, 0, 0, crs=LOCAL_WKT)
    with page_of(tmp_path) as page:
        tab = browser.new_page(viewport=SIZE)
        found = {}
        for tool, points in (
            ("ruler", "0.1,-0.08;0.103,-0.084"),
            ("area", "0.06,-0.04;0.14,-0.04;0.14,-0.12;0.06,-0.12"),
            ("section", "0.06,-0.08;0.14,-0.08"),
        ):
            tab.goto("about:blank")
            tab.goto(f"{page.address}/#tool={tool}&points={points}&left=0.height")
            tab.locator('#result[aria-busy="false"]').wait_for()
            found[tool] = tab.locator("#result").inner_text()
            colours(tab, f"small_{tool}")
        legend = tab.locator("#legendends").inner_text()
        tab.close()
    assert re.search(r"^Distance 0.00500 units\s", found["ruler"])
    assert re.search(r"^Area 0.00640 square units\s", found["area"])
    above = float(re.search(r"above its rim\s+([\d.]+) cubic units", found["area"]).group(1))
    assert above == pytest.approx(0.02 * 50 * np.pi * 0.002**2, rel=0.01)
    assert found["section"].startswith("Section of 0.0800 units")
    assert re.search(r"^2\.00000 to 2\.007\d\d units", legend)


def test_a_section_shows_the_change_where_maps_have_no_heights(tmp_path: Path, browser):
    write_surface(tmp_path / "ortho" / "ortho.tif", np.full((3, *SHAPE), 90, np.uint8), CELL)
    change = write_change(tmp_path / "change", np.full(SHAPE, 0.4, np.float32))
    points = ";".join("{:.3f},{:.3f}".format(*corner(*at)) for at in ((20, 30), (75, 45)))
    with page_of(tmp_path / "ortho", change) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(f"{page.address}/#tool=section&points={points}")
        tab.locator('#result[aria-busy="false"]').wait_for()
        assert tab.locator("#result").inner_text().endswith("change; bands: 95%")
        tab.close()


@pytest.mark.thorough
def test_surveys_of_a_section_have_colours_of_their_own(tmp_path: Path, browser):
    rows, columns = np.indices(SHAPE)
    maps = [
        write_map(tmp_path / f"map 202{k}-01-01", (90, 120, 60), 5 + 0.01 * columns + 0.5 * k + 0 * rows)
        for k in range(7)
    ]
    points = ";".join("{:.3f},{:.3f}".format(*corner(*at)) for at in ((20, 30), (75, 45)))
    with page_of(*maps) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(f"{page.address}/#tool=section&points={points}")
        tab.locator('#result[aria-busy="false"]').wait_for()
        inks = tab.evaluate("[...document.querySelectorAll('#result span')].map(word => getComputedStyle(word).color)")
        colours(tab, "section")
        tab.close()
    assert len(inks) == 7
    between = [np.abs(np.subtract(a, b)).sum() for a, b in combinations([_rgb(ink) for ink in inks], 2)]
    assert min(between) > 60


def _rgb(ink: str) -> list[int]:
    return [int(value) for value in re.findall(r"\d+", ink)[:3]]


def test_the_level_of_detection_hides_smaller_changes_and_the_area_has_the_volume(tmp_path: Path, browser):
    dz = np.full(SHAPE, 0.1, np.float32)
    dz[:, 50:] = -0.5
    dz[:10] = np.nan
    with page_of(write_change(tmp_path / "change", dz)) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.address)
        not_compared = tuple(map(round, pixel_of(tab, corner(25, 5))))
        left, right = (tuple(map(round, pixel_of(tab, corner(c, 40)))) for c in (25, 75))
        picture, ground = colours(tab, "detection_low"), (233, 237, 240)
        assert picture[right[1], right[0], 0] > picture[right[1], right[0], 2] + 50  # lower is red
        assert tuple(picture[left[1], left[0]]) != ground
        tab.get_by_label("Detection").fill("0.3")
        picture = colours(tab, "detection_high")
        assert tuple(picture[left[1], left[0]]) == (255, 255, 255)
        assert tuple(picture[not_compared[1], not_compared[0]]) == ground
        assert tuple(picture[right[1], right[0]]) not in (ground, (255, 255, 255))
        tab.get_by_role("button", name="Area").click()
        for place in (corner(60, 30), corner(80, 30), corner(80, 50), corner(60, 50)):
            tab.mouse.click(*pixel_of(tab, place))
        tab.locator('#result[aria-busy="false"]').wait_for()  # the answer to the last corner, not to the one before
        assert re.match(r"Area (9|10)\d", tab.locator("#result").inner_text())
        row = tab.get_by_role("row").filter(has_text="net change").inner_text()
        colours(tab, "area")
        tab.close()
    assert float(re.search(r"(-[\d.]+) m³", row).group(1)) == pytest.approx(-400 * 0.5 * 0.25, rel=0.05)


def test_the_legend_has_the_unit_of_its_layer_and_the_detection_its_step(tmp_path: Path, browser):
    change = write_change(tmp_path / "change", np.full(SHAPE, 0.1, np.float32))
    with page_of(write_map(tmp_path / "map 2023-05-01", (90, 120, 60)), change) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.address)
        for layer, ends in (
            ("0.height", r"\d m$"),
            ("0.error", r"\d m$"),
            ("1.error", r"\d m$"),
            ("1.change", r"\d m \(red"),
        ):
            tab.locator("#left").select_option(layer)
            assert re.search(ends, tab.locator("#legendends").inner_text())
        tab.get_by_label("Detection").fill("0.057")
        assert tab.locator("#detectionvalue").inner_text() == "0.057 m"
        tab.close()


def test_on_a_phone_nothing_leaves_the_screen(tmp_path: Path, browser):
    with page_of(*two_dates(tmp_path)) as page:
        context = browser.new_context(viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True)
        tab = context.new_page()
        tab.goto(page.address)
        tab.get_by_role("button", name="Section").tap()
        tab.touchscreen.tap(120, 400)
        tab.touchscreen.tap(260, 420)
        tab.get_by_text("Section of").wait_for()
        colours(tab, "phone")
        for name in ("#controls", "#place", "#result"):
            found = tab.locator(name).bounding_box()
            assert found is not None
            assert found["x"] >= 0
            assert found["x"] + found["width"] <= 390
            assert found["y"] + found["height"] <= 780
        tab.close()
        context.close()


@pytest.mark.thorough
def test_the_address_keeps_a_detection_of_zero_and_a_new_one_shows_nothing_that_it_lacks(tmp_path: Path, browser):
    change = write_change(tmp_path / "change", np.full(SHAPE, 0.03, np.float32))
    with page_of(change) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.address)
        place = tuple(map(round, pixel_of(tab, corner(50, 40))))
        assert tuple(colours(tab, "hidden")[place[1], place[0]]) == (255, 255, 255)
        tab.get_by_label("Detection").fill("0")
        tab.wait_for_url(re.compile("detection=0&"))
        plain = tab.evaluate("location.hash")
        again = browser.new_page(viewport=SIZE)
        again.goto(page.address + "/" + plain)
        assert tuple(colours(again, "zero")[place[1], place[0]]) != (255, 255, 255)
        assert again.get_by_label("Detection").input_value() == "0"
        again.get_by_label("Swipe").check()
        again.get_by_role("button", name="Ruler").click()
        again.mouse.click(place[0] - 100, place[1])
        again.wait_for_url(re.compile("swipe=.*points="))
        again.evaluate(f"location.hash = {json.dumps(plain)}")
        again.wait_for_function("!document.getElementById('swipe').checked")
        assert again.evaluate("[state.swipe, state.points.length]") == [None, 0]
        tab.close()
        again.close()


def test_tiles_that_fail_are_asked_for_again_and_those_not_shown_any_more_are_not_waited_for(tmp_path: Path, browser):
    with page_of(write_map(tmp_path / "map", (200, 30, 30))) as page:
        tab = browser.new_page(viewport=SIZE)
        failed: list[str] = []
        tab.on("requestfailed", lambda request: failed.append(f"{request.url} {request.failure}"))
        tab.route("**/tile/0/orthophoto/**", lambda route: route.abort(), times=1)
        tab.goto(page.address)
        assert tuple(colours(tab, "again")[350, 450]) == (200, 30, 30)
        # On a busy machine a coarse tile is not waited for either, once finer ones are there.
        assert len([one for one in failed if "ERR_ABORTED" not in one]) == 1
        held: list[Any] = []
        tab.route("**/tile/0/height/**", lambda route: held.append(route))
        with tab.expect_request("**/tile/0/height/**"):
            tab.get_by_label("Layer", exact=True).select_option("0.height")
        with tab.expect_event("requestfailed"):
            tab.get_by_label("Layer", exact=True).select_option("0.orthophoto")
        assert [one for one in failed if "/tile/0/height/" in one and "ERR_ABORTED" in one]
        tab.unroute("**/tile/0/height/**")
        tab.get_by_label("Layer", exact=True).select_option("0.height")
        colours(tab, "height")
        tab.close()


def test_a_raster_that_cannot_be_read_is_reported_on_the_page_and_once_in_the_log(
    tmp_path: Path, browser, caplog: pytest.LogCaptureFixture
):
    folder = write_map(tmp_path / "map", (200, 30, 30), np.random.default_rng(0).uniform(0, 9, SHAPE))
    with page_of(folder) as page:
        surface = folder / "odm_dem" / "dsm.tif"
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.address)
        colours(tab, "readable")
        os.truncate(surface, surface.stat().st_size // 2)
        tab.get_by_label("Layer", exact=True).select_option("0.height")
        tab.get_by_role("alert").filter(has_text="not a raster").wait_for()
        colours(tab, "unreadable")  # it is not asked for again and again
        words = tab.get_by_role("alert").inner_text()
        tab.close()
    assert re.search(r"map, Height: map.odm_dem.dsm\.tif is not a raster that can be read", words)
    assert str(tmp_path) not in words
    # The browser's driver logs tasks that earlier tests have left.
    (warning,) = [record.getMessage() for record in caplog.records if record.name.startswith("tidefield")]
    assert str(surface) in warning


def test_a_map_that_was_made_again_is_shown_when_the_page_is_loaded_again(tmp_path: Path):
    folder = write_map(tmp_path / "map", (200, 30, 30))
    with page_of(folder) as page:

        def asked(path: str) -> Any:
            with urllib.request.urlopen(f"{page.address}/{path}") as answer:
                return json.load(answer)

        first = asked("atlas.json")
        assert asked("atlas.json") == first
        write_map(tmp_path / "map", (30, 30, 200), np.full((*SHAPE[:1], 2 * SHAPE[1]), 3.0))
        again = asked("atlas.json")
        assert again["version"] != first["version"]
        assert again["bounds"][2] > first["bounds"][2]
        assert asked("atlas.json") == again
        tile = "tile/0/height/0/0/0.png?version="
        urllib.request.urlopen(f"{page.address}/{tile}{again['version']}").close()
        x, y = corner(5, 5)
        for question in (tile, f"at?points={x},{y}&version="):
            with pytest.raises(urllib.error.HTTPError) as refusal:
                asked(question + first["version"])
            assert "reload this page" in json.load(refusal.value)["error"]
        (folder / "odm_dem" / "dsm.tif").write_bytes(b"II*\0 half of it")
        with pytest.raises(urllib.error.HTTPError) as refusal:
            asked("atlas.json")
        assert "map/odm_dem/dsm.tif is not a raster" in json.load(refusal.value)["error"].replace("\\", "/")


def test_sheets_of_one_date_are_named_apart_and_detection_goes_up_to_the_largest_change(tmp_path: Path, browser):
    dz = np.random.default_rng(0).normal(0, 0.03, SHAPE).astype(np.float32)
    dz[:4, :4] = -0.8
    maps = [write_map(tmp_path / name, (200, 30, 30)) for name in ("low 2024-05-01", "high 2024-05-01")]
    with page_of(*maps, write_change(tmp_path / "change", dz)) as page:
        tab = browser.new_page(viewport=SIZE)
        tab.goto(f"{page.address}/#left=2.change")
        names = tab.get_by_label("Layer", exact=True).locator("option").all_inner_texts()
        assert len(set(names)) == len(names)
        assert {"low 2024-05-01 Height", "high 2024-05-01 Height", "2024-05-03 Change"} <= set(names)
        assert tab.locator("#legendends").inner_text().startswith("-0.12 to 0.12 m")
        tab.get_by_label("Detection").fill("0.8")
        assert tab.locator("#detectionvalue").inner_text() == "0.800 m"
        place = tuple(map(round, pixel_of(tab, corner(50, 40))))
        tab.mouse.move(*place)
        tab.get_by_text("low 2024-05-01: height").wait_for()
        assert tuple(colours(tab, "labels")[place[1], place[0]]) == (255, 255, 255)
        tab.close()


def test_areas_are_asked_for_one_at_a_time_and_of_those_that_wait_the_last(tmp_path: Path, browser):
    with page_of(write_change(tmp_path / "change", np.full(SHAPE, -0.5, np.float32))) as page:
        tab = browser.new_page(viewport=SIZE)
        held: list[Any] = []
        asked: list[str] = []
        tab.route("**/area?**", lambda route: held.append(route), times=1)
        tab.on("request", lambda request: asked.append(request.url) if "/area?" in request.url else None)
        points = ";".join("{:.3f},{:.3f}".format(*corner(*at)) for at in ((60, 30), (80, 30), (80, 50)))
        tab.goto(f"{page.address}/#tool=area&points={points}")
        tab.get_by_label("Detection").wait_for()
        for level in ("0.1", "0.2", "0.3"):
            tab.get_by_label("Detection").fill(level)
        tab.wait_for_timeout(500)
        assert len(asked) == 1
        held[0].continue_()
        tab.locator('#result[aria-busy="false"]').wait_for()
        assert len(asked) == 2
        assert "detection=0.3" in asked[1]
        assert "net change" in tab.locator("#result").inner_text()
        tab.close()


def test_a_browser_keeps_the_tiles_of_each_server_apart(tmp_path: Path, browser):
    versions = set()
    for folder in two_dates(tmp_path):
        with page_of(folder) as page:
            tab = browser.new_page(viewport=SIZE)
            with tab.expect_request("**/tile/**") as tile:
                tab.goto(page.address)
            versions.add(urlsplit(tile.value.url).query)
            tab.close()
    assert len(versions - {""}) == 2


def test_a_page_of_an_ipv6_address_answers(tmp_path: Path):
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("needs IPv6, which this machine does not have")
    page = MapPage(Atlas([write_map(tmp_path / "map", (1, 2, 3))]), "::1", 0)
    try:
        assert page.address.startswith("http://[::1]:")
        with urllib.request.urlopen(page.address) as answer:
            assert answer.status == 200
    finally:
        page.close()


def test_a_browser_that_has_moved_on_is_no_defect(caplog: pytest.LogCaptureFixture):
    handler = _Handler.__new__(_Handler)
    handler.server = _Server.__new__(_Server)
    handler.server.local, handler.path, handler.close_connection = False, "/", False

    def refuse(*_: object) -> None:
        raise ConnectionAbortedError

    handler._answer = refuse
    handler.do_GET()
    assert handler.close_connection
    assert caplog.text == ""


def test_connections_that_fail_print_nothing_on_the_terminal(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    def answer(port: int, question: bytes) -> bytes:
        """What the server says first, before the browser resets the connection."""
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.settimeout(20)
            connection.sendall(question)
            found = connection.recv(1 << 16)
            linger = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        end = time.monotonic() + 20
        while any("process_request" in thread.name for thread in threading.enumerate()):
            assert time.monotonic() < end, "the server still waits"
            time.sleep(0.01)
        return found

    caplog.set_level(logging.INFO, "tidefield")
    with page_of(write_map(tmp_path / "map", (1, 2, 3))) as page:
        port = int(page.address.rpartition(":")[2])
        assert answer(port, b"GET /atlas.json HTTP/1.1\r\nHost: localhost\r\n\r\n").startswith(b"HTTP/1.1 200")
        for question in (b"GET / HTTP/1.1\r\nHost: [", b"GET http://[ HTTP/1.1\r\nHost: localhost"):
            assert answer(port, question + b"\r\n\r\n").startswith(b"HTTP/1.1 400")
        assert caplog.text == ""
        monkeypatch.setattr(_Handler, "parse_request", lambda _: 1 // 0)
        answer(port, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert "ZeroDivisionError" in caplog.text
    assert capsys.readouterr().err == ""


def test_the_server_answers_nothing_but_its_page(tmp_path: Path):
    with page_of(write_map(tmp_path / "map", (1, 2, 3))) as page:
        port = int(page.address.rpartition(":")[2])

        def status(path: str, host: str = "localhost") -> tuple[int, bytes]:
            connection = http.client.HTTPConnection("127.0.0.1", port)
            connection.putrequest("GET", path, skip_host=True)
            connection.putheader("Host", host)
            connection.endheaders()
            answer = connection.getresponse()
            content = answer.read()
            connection.close()
            return answer.status, content

        assert status("/")[0] == 200
        assert status("/", "attacker.example")[0] == 403
        for path in ("/../map.json", "/%2e%2e/map.json", "/tile/0/../../map.json", "/map.json", "/etc/passwd"):
            assert status(path)[0] == 404
        for path in ("/at", "/at?points=1", "/at?points=nan,1", "/at?points=1,1e99", "/area?points=1,1;2,2"):
            code, content = status(path)
            assert code == 400
            assert "expected" in json.loads(content)["error"]
        assert status("/section?points=" + ";".join(["1,1"] * 501))[0] == 400
        assert status("/tile/0/height/0/9/9.png")[0] == 204
        assert status("/tile/0/height/0/0/0.png")[1][:4] == b"\x89PNG"
