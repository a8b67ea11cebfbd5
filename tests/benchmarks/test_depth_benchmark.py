"""The benchmark of depths: errors that are put in come out, plants and banks apart."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks.depth import compare_depths, depth, tables
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render, Rendering
from tidefield.synthetic.write import GROUND


def off_by(scene: Scene, metres: float) -> Render:
    """The true depth of a held-out view, and so many metres more."""

    def render(camera: Cameras) -> Rendering:
        distance = (scene.cameras.position_world - camera.position_world).norm(dim=-1)
        stem = Path(scene.names[int(distance.argmin())]).stem
        depth = torch.from_numpy(np.load(scene.root / "truth" / "depth" / f"{stem}.npy")) + metres
        return Rendering(depth[..., None].expand(-1, -1, 3), depth, torch.ones_like(depth))

    return render


@pytest.mark.thorough
def test_known_errors_come_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    scenes: list[Scene] = []

    def zero_shot(config: object, file: Path, scene: Scene, device: object) -> tuple[Render, str]:
        scenes.append(scene)
        return off_by(scene, 0.25), ""

    monkeypatch.setattr("benchmarks.depth.zero_shot", zero_shot)

    def measure(weights: str) -> dict:
        monkeypatch.setattr("benchmarks.depth.weights_sha256", lambda _: weights)
        return depth(tmp_path, tmp_path, ("tidal_trees",), 160, 8, 3)

    measure("first")
    record = measure("first")
    assert len(scenes) == 1
    [figures] = record["figures"].values()
    for part in ("all", "vegetation", "edges"):
        assert figures[part]["rendered"]["mean_m"] == pytest.approx(0.25, abs=1e-5)
        assert figures[part]["rendered"]["nmad_m"] == pytest.approx(0, abs=1e-5)
        assert figures[part]["points"]["nmad_m"] > 0.01
    # Points do not stand on plants, which rise above them.
    assert figures["vegetation"]["points"]["rmse_m"] > 2 * figures["edges"]["points"]["rmse_m"]
    assert 0 < figures["edges"]["share"] < 0.5
    assert "| 25.0 | 0.0 | 25.0 |" in tables(record)[0].markdown()
    assert measure("second")["method"] == {"preset": "swift", "weights": "second"}
    assert len(scenes) == 2
    # A part that no pixel belongs to has no figures.
    classes = scenes[0].root / "truth" / "classes.png"
    picture = cv2.imread(str(classes), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    cv2.imwrite(str(classes), np.minimum(picture, GROUND))
    figures = compare_depths(scenes[0], off_by(scenes[0], 0.0))
    assert figures["vegetation"] is None
    assert tables({"figures": {"flat": figures}})[1].rows == []
