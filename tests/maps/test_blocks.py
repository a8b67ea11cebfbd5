"""Tiles of a map: the blocks of them that workers of a cluster make, and what a map continues with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
from shapely.geometry.base import BaseGeometry

from tidefield.errors import RunError
from tidefield.files import read_json
from tidefield.maps import make
from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame, Tile
from tidefield.maps.make import MAP_FILE, TILES, Job, TileMaker, begin, make_missing, make_tiles, tile_file


class Tiled(Job):
    """A job without a scene."""

    def __init__(self, columns: int, rows: int, area: BaseGeometry | None = None) -> None:
        frame = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
        self.__dict__.update(grid=Grid(frame, 0.0, 100.0, 0.5, columns, rows, 0.0), area=area)

    @property
    def key(self) -> str:
        return "this"

    def tiles(self) -> list[Tile]:
        return self.grid.tiles(64, 16)


def written(own: Job, out: Path, numbers: list[int], but: tuple[int, ...] = ()) -> Iterator[int]:
    """Make tiles, of which some get lost."""
    for number in numbers:
        if number not in but:
            tile_file(out, own.tiles()[number]).parent.mkdir(exist_ok=True, parents=True)
            tile_file(out, own.tiles()[number]).touch()
        yield number


@pytest.mark.parametrize("workers", [1, 2, 7, 500])
def test_every_tile_is_in_one_block_of_neighbours(workers: int) -> None:
    own = Tiled(10 * 64, 10 * 64 - 5)
    wanted = [number for number in range(100) if number % 7]
    blocks = own.blocks(wanted, workers)
    assert sorted(number for block in blocks for number in block) == wanted
    assert len(blocks) >= min(len(wanted), 4 * workers)
    side = max(int(np.ptp([number // 10 for number in block])) + 1 for block in blocks)
    assert side**2 <= max(1, len(wanted) / (4 * workers))
    for block in blocks:
        assert len(block) <= side**2
        assert np.ptp([number % 10 for number in block]) < side


def test_a_worker_makes_what_another_has_not_finished(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = Tiled(3 * 64, 64)
    made: list[int] = []
    monkeypatch.setattr(make, "tile_file", lambda out, tile: out / f"{tile.column}.npz")
    maker = SimpleNamespace(_out=tmp_path, _tiles=own.tiles())
    (tmp_path / f"{own.tiles()[1].column}.npz").touch()
    monkeypatch.setattr(TileMaker, "__call__", lambda self, number: made.append(number))

    class Maker(TileMaker):
        def __init__(self) -> None:
            self.__dict__.update(vars(maker))

    assert list(Maker().block([0, 1, 2])) == [0, 1, 2]
    assert made == [0, 2]


def test_tiles_that_no_worker_has_left_in_the_folder_are_no_holes_of_the_map(tmp_path: Path) -> None:
    own, shown = Tiled(3 * 64, 3 * 64), []
    with pytest.raises(RunError, match=r"2 of the 9 tiles that were made are not in .*that all machines share"):
        make_missing(own, tmp_path, lambda *_: None, partial(written, own, tmp_path, but=(4, 7)))
    assert len(list((tmp_path / TILES).iterdir())) == 7
    make_missing(own, tmp_path, lambda *done: shown.append(done), partial(written, own, tmp_path))
    assert shown == [(8, 9), (9, 9)], "those two are made again"
    corner = Tiled(3 * 64, 3 * 64, shapely.box(0, 90, 5, 100))
    make_missing(corner, tmp_path / "corner", lambda *_: None, partial(written, own, tmp_path / "corner"))
    assert len(list((tmp_path / "corner" / TILES).iterdir())) == 1


def test_the_folder_of_the_tiles_is_listed_as_often_for_many_as_for_few(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed, glob = [], Path.glob
    monkeypatch.setattr(Path, "glob", lambda path, *pattern: listed.append(path) or glob(path, *pattern))
    counts = []
    for side in (2, 5):
        own, out = Tiled(side * 64, side * 64), tmp_path / str(side)
        left = out / TILES / ".0_0-01234567.partial.npz"
        left.parent.mkdir(parents=True)
        left.touch()
        make_missing(own, out, lambda *_: None, partial(written, own, out))
        assert not left.exists()
        counts.append(len(listed))
        listed.clear()
    assert counts[0] == counts[1]


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_time_of_a_map_is_that_of_all_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
) -> None:
    clock = [0.0]
    monkeypatch.setattr(make, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    def makes(hours: float, killed: bool, numbers: list[int]) -> Iterator[int]:
        clock[0] += hours
        yield from written(own, tmp_path, numbers[: 1 if killed else None])
        if killed:
            raise KeyboardInterrupt

    def bar(_: str) -> Any:
        return nullcontext(lambda *_: None)

    own = Tiled(3 * 64, 64)
    with pytest.raises(KeyboardInterrupt):
        make_tiles(own, tmp_path, False, bar, partial(makes, 8.0, True))
    make_tiles(own, tmp_path, overwrite, bar, partial(makes, 2.0, False))
    assert read_json(tmp_path / MAP_FILE) == {"key": "this", "complete": False, "seconds": 10.0}


def test_tiles_of_another_interrupted_map_are_deleted_when_it_is_overwritten(tmp_path: Path) -> None:
    own = Tiled(64, 64)
    begin(tmp_path, "this", False)
    for key, kept in (("this", True), ("other", False)):
        list(written(own, tmp_path, [0]))
        begin(tmp_path, key, True)
        assert tile_file(tmp_path, own.tiles()[0]).exists() == kept
