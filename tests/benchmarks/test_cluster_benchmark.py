from __future__ import annotations

import json
import os
import random
import sys
import time
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest

from benchmarks import cluster
from tidefield.data.georeference import Georeference, Residuals
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.synthetic import make_survey, write_survey

FRAME = LocalFrame.at("EPSG:27700+5701", (351_200.0, 512_900.0, 260.0))


def test_workers_are_killed_between_the_first_and_the_last_tiles() -> None:
    for seed in range(20):
        after = cluster._moments(30, 10, random.Random(seed))
        assert len(set(after)) == 10
        assert after == sorted(after)
        assert after[0] >= 1
        assert after[-1] < 28


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_that_work_on_tiles_are_found() -> None:
    sleep = "import time; time.sleep(60)"
    with Popen(["ray::_each", "-c", sleep], executable=sys.executable) as worker:
        with Popen([sys.executable, "-c", sleep]) as other:
            end = time.monotonic() + 10
            while worker.pid not in cluster._workers() and time.monotonic() < end:
                time.sleep(0.05)
            found = cluster._workers()
            other.kill()
        worker.kill()
    assert worker.pid in found
    assert other.pid not in found


def test_maps_are_the_same_if_all_their_files_are(tmp_path: Path) -> None:
    for name in ("one", "two", "killed"):
        for file in ("a/x.tif", "b.laz", "report.html"):
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"report" + name.encode() if file == "report.html" else file.encode())
    maps = [tmp_path / name for name in ("one", "two", "killed")]
    assert cluster._compare(maps) == (2, [])
    (tmp_path / "two" / "b.laz").write_bytes(b"B.laz")
    (tmp_path / "killed" / "a/x.tif").unlink()
    assert cluster._compare(maps) == (2, [os.path.join("a", "x.tif"), "b.laz"])


@pytest.mark.thorough
def test_a_survey_that_is_too_small_is_refused(tmp_path: Path) -> None:
    survey = make_survey("ground_textures", seed=4, views=9, width=96, supersample=1)
    write_survey(survey, tmp_path / "scene")
    with pytest.raises(RunError, match="not georeferenced"):
        cluster._square(tmp_path / "scene", tmp_path / "work", 4.0, 2.0)
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(FRAME, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(tmp_path / "scene")
    with pytest.raises(RunError, match="smaller than 10000 m"):
        cluster._square(tmp_path / "scene", tmp_path / "work", 10000.0, 2.0)
    square, tiles = cluster._square(tmp_path / "scene", tmp_path / "work", 4.0, 2.0)
    ring = json.loads(square.read_text())["features"][0]["geometry"]["coordinates"][0]
    assert np.ptp(np.array(ring), axis=0) == pytest.approx([4.0, 4.0])
    assert tiles >= 1


def test_the_table_compares_with_one_worker() -> None:
    own = {"kills": 0, "tiles_seconds": 100.0, "seconds": 120.0}
    maps = {"one": own, "two": own | {"tiles_seconds": 50.0, "seconds": 75.0}, "killed": own | {"kills": 10}}
    (table,) = cluster.tables({"square_metres": 100.0, "cell_m": 0.2, "tiles": 7, "maps": maps})
    assert table.rows[1] == ["two workers", "0", "50", "2.00", "75", "1.60"]
    assert table.rows[2][:2] == ["two workers, killed", "10"]
