"""The surface at ground control: of a flat whose heights are known, and in a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.map_control import map_control, tables
from tidefield.data.georeference import Georeference, LeftOut, Residuals
from tidefield.errors import RunError
from tidefield.files import read_json
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.synthetic import make_survey, write_survey

pytest.importorskip("rasterio")
FRAME = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))


@pytest.mark.thorough
def test_the_surface_misses_points_by_what_they_were_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    survey = make_survey("ground_textures", seed=4, views=9, width=240)
    write_survey(survey, tmp_path / "scene")
    with pytest.raises(RunError, match="no ground control"):
        map_control(tmp_path / "scene", tmp_path / "gcp_list.txt", tmp_path / "runs")
    places = np.array([[1.0, 2.0], [-3.0, 1.0], [2.0, -3.0]])
    heights = survey.flat.surface.sample(torch.from_numpy(places.T).float())[0].numpy()
    moved = np.array([0.0, 0.0, -1.0])  # the third point was surveyed a metre too low
    surveyed = FRAME.to_crs(np.column_stack([places, heights + moved]))
    lines = ["EPSG:27700"]
    for name, point in zip("abc", surveyed, strict=True):
        shown = np.column_stack([places, heights])["abc".index(name)]
        uv = survey.cameras[4].project(torch.from_numpy(shown[None]).float())[0][0, 0].tolist()
        lines.append(
            f"{point[0]:.4f} {point[1]:.4f} {point[2]:.4f} {uv[0]:.2f} {uv[1]:.2f} ground_textures_0005.png {name}"
        )
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines) + "\n")
    with_it = Residuals(("a", "b"), np.zeros((2, 3)))
    without = Residuals(("a", "b"), np.array([[0, 0, 0.5], [0, 0, -0.5]]))
    refused = (LeftOut("control point", "c", "it is a metre off"),)
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    georeference = Georeference(FRAME, "ground control", there, Residuals(), with_it, without, refused, ())
    georeference.write(tmp_path / "scene")
    record = map_control(tmp_path / "scene", tmp_path / "gcp_list.txt", tmp_path / "runs")
    assert read_json(tmp_path / "runs" / "map_control.json") == record
    a, b, c = record["points"]
    for one, surface in ((a, 0.0), (b, 0.0), (c, 1.0)):
        assert one["surface"] == pytest.approx(surface, abs=0.15)  # pixels show 24 cm
    assert a["mark_px"] < 0.1 < 0.5 < c["mark_px"]
    assert a["left_out"] - a["surface"] == pytest.approx(0.5)
    assert b["left_out"] - b["surface"] == pytest.approx(-0.5)
    assert (record["n"], c["refused"]) == (2, True)
    assert record["rmse_m"] == pytest.approx(0.5, abs=0.15)
    first, second = (table.markdown() for table in tables(record))
    assert "refused by prepare" in first
    assert f"| 2 | {100 * record['rmse_m']:.1f} |" in second
