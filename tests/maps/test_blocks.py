"""Blocks of tiles: what a worker of a cluster makes at a time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tidefield.maps import make
from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame
from tidefield.maps.make import Job, TileMaker


def job(columns: int, rows: int) -> Job:
    frame = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
    grid = Grid(frame, 0.0, 100.0, 0.5, columns, rows, 0.0)
    return cast(Job, SimpleNamespace(tiles=lambda: grid.tiles(64, 16)))


@pytest.mark.parametrize("workers", [1, 2, 7, 500])
def test_every_tile_is_in_one_block_of_neighbours(workers: int) -> None:
    own = job(10 * 64, 10 * 64 - 5)
    wanted = [number for number in range(100) if number % 7]
    blocks = Job.blocks(own, wanted, workers)
    assert sorted(number for block in blocks for number in block) == wanted
    assert len(blocks) >= min(len(wanted), 4 * workers)
    side = max(int(np.ptp([number // 10 for number in block])) + 1 for block in blocks)
    assert side**2 <= max(1, len(wanted) / (4 * workers))
    for block in blocks:
        assert len(block) <= side**2
        assert np.ptp([number % 10 for number in block]) < side


def test_a_worker_makes_what_another_has_not_finished(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = job(3 * 64, 64)
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
