"""The server of the page of maps: one file of HTML, tiles, and values as JSON; nothing else can be asked for."""

from __future__ import annotations

import json
import logging
import math
import re
import secrets
import sys
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

import numpy as np
from jaxtyping import Float64

from tidefield.errors import RunError, TidefieldError
from tidefield.viewer.atlas import MOST_POINTS, Atlas
from tidefield.viewer.ports import LOCAL_HOSTS, page_address, require_port
from tidefield.viewer.words import without_folders

log = logging.getLogger(__name__)

PAGE = Path(__file__).parent / "templates" / "map_page.html"
LARGEST_COORDINATE = 1e9
_TILE = re.compile(r"/tile/(\d{1,4})/([a-z]{1,20})/(\d{1,2})/(\d{1,8})/(\d{1,8})\.png")
_POLICY = "default-src 'self'; img-src 'self' data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


class MapPage:
    """Serves maps and changes.

    Args:
        atlas: what is shown.
        host, port: where to listen.
    """

    def __init__(self, atlas: Atlas, host: str, port: int) -> None:
        self.atlas = atlas
        self._server = _Server(atlas, host, port)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Where the page is."""
        host, port = self._server.server_address[:2]
        return page_address(str(host), port)

    def close(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, atlas: Atlas, host: str, port: int) -> None:
        self.address_family = require_port(host, port)
        super().__init__((host, port), _Handler)
        self.local = host in LOCAL_HOSTS
        self._renewing = threading.Lock()
        self._show(atlas)

    def _show(self, atlas: Atlas) -> None:
        self.atlas = atlas
        # Other maps have the same addresses: browsers keep the tiles of each server, and of a map that was made again,
        # apart by this.
        self.version = secrets.token_hex(8)
        self.unreadable: set[tuple[str, ...]] = set()

    def renewed(self) -> tuple[Atlas, str]:
        """What is shown, read again where files have changed, and its version."""
        with self._renewing:
            if self.atlas.is_outdated:
                self._show(Atlas(self.atlas.folders))
            return self.atlas, self.version

    def require_current(self, query: dict[str, list[str]]) -> None:
        """Raises: RunError when the files have changed since a page was loaded: its colours and corners are others."""
        if "version" in query and (query["version"] != [self.version] or self.atlas.is_outdated):
            raise RunError("the maps were made again: reload this page")

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log what has ended a connection; Python would print it on the terminal, whatever was asked for."""
        error = sys.exception()
        if isinstance(error, ConnectionError):
            log.debug("a browser has gone: %s", error)
        else:
            log.exception("a connection of the page failed")


class _Handler(BaseHTTPRequestHandler):
    server_version, sys_version = "tidefield", ""
    protocol_version = "HTTP/1.1"
    timeout = 60

    @property
    def _own(self) -> _Server:
        assert isinstance(self.server, _Server)
        return self.server

    def do_GET(self) -> None:
        try:
            if self._own.local and (_split(f"//{self.headers.get('Host', '')}").hostname or "") not in LOCAL_HOSTS:
                # Another site's name that points to this machine: its page could read ours.
                self._send(HTTPStatus.FORBIDDEN, "text/plain", b"this page is for this machine only")
                return
            parts = _split(self.path)
            self._answer(parts.path, parse_qs(parts.query))
        except TidefieldError as error:
            self._json({"error": without_folders(str(error), self._own.atlas.folders)}, HTTPStatus.BAD_REQUEST)
        except (ConnectionError, TimeoutError):
            self.close_connection = True  # the browser has moved on
        except Exception:
            log.exception("a question of the page could not be answered")
            self._json({"error": "a defect of the program: the terminal has the details"}, HTTPStatus(500))

    def _answer(self, path: str, query: dict[str, list[str]]) -> None:
        atlas = self._own.atlas
        if path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.read_bytes())
        elif path == "/atlas.json":
            atlas, version = self._own.renewed()
            self._json({**atlas.describe(), "version": version})
        elif path in ("/at", "/section", "/area"):
            measured = _measure(atlas, path, query)
            self._own.require_current(query)
            self._json(measured)
        elif found := _TILE.fullmatch(path):
            sheet, layer, level, column, row = found.groups()
            try:
                content = atlas.tile(int(sheet), layer, int(level), int(column), int(row))
            except TidefieldError as error:
                if (sheet, layer) not in self._own.unreadable:  # which has many tiles
                    self._own.unreadable.add((sheet, layer))
                    log.warning(str(error))
                raise
            self._own.require_current(query)
            if content is None:
                self._send(HTTPStatus.NO_CONTENT, "image/png", b"")
            else:
                self._send(HTTPStatus.OK, "image/png", content, "max-age=600")
        else:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"there is nothing here")

    def _json(self, data: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(status, "application/json", json.dumps(data, allow_nan=False).encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes, cache: str = "no-store") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", cache)
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *values: Any) -> None:
        log.debug(format, *values)


def _measure(atlas: Atlas, path: str, query: dict[str, list[str]]) -> Any:
    """The answer to a question about places."""
    if path == "/at":
        (point,) = _points(query, 1, 1)
        return atlas.at(*point.tolist())
    if path == "/section":
        return atlas.section(_points(query, 2, MOST_POINTS))
    detection = _number(query.get("detection", ["0"])[0])
    return atlas.area(_points(query, 3, MOST_POINTS), max(0.0, detection))


def _split(address: str) -> SplitResult:
    try:
        return urlsplit(address)
    except ValueError as error:
        raise RunError(f"{address[:40]!r} is no address: expected one of the page") from error


def _points(query: dict[str, list[str]], least: int, most: int) -> Float64[np.ndarray, "N 2"]:
    """The places of a question, `points=x,y;x,y`."""
    words = [word.split(",") for word in query.get("points", [""])[0].split(";")]
    if not least <= len(words) <= most or any(len(pair) != 2 for pair in words):
        raise RunError(f"{len(words)} places were asked for: expected {least} to {most}, as x,y;x,y")
    return np.array([[_number(word) for word in pair] for pair in words])


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST_COORDINATE:
        raise RunError(f"{word[:40]!r} is no coordinate: expected a number")
    return value
