"""The benchmark of the paper's parts: each weights file is measured with its own network, once."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.parts import parts, tables
from tidefield.config import SWIFT, Config, vary
from tidefield.model.network import make_network
from tidefield.synthetic import make_survey, write_survey
from tidefield.train.checkpoint import write_weights


@pytest.mark.thorough
def test_weights_are_compared_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = tmp_path / "flat"
    write_survey(make_survey("ground_textures", seed=5, views=9, width=64), scene)
    files = []
    for config in (SWIFT, vary(SWIFT, "with-every-part")):
        assert isinstance(config, Config)
        torch.manual_seed(0)
        validation = [{"step": 5, "seconds": 1.0, "psnr": {"flat": 20.0 + len(files)}}]
        about = {"steps": 5, "seconds": 1.0, "seed": 0, "real": [], "validation": validation}
        files.append(tmp_path / f"{len(files)}.safetensors")
        write_weights(files[-1], make_network(config.network), config, about)
    lines: list[str] = []
    monkeypatch.setattr("benchmarks.parts.say", lines.append)
    for _ in range(2):
        record = parts(tuple(files), (scene,), tmp_path, 64, "cpu")
    assert len(lines) == 2, "what was measured is not measured again"
    (figures,) = record["figures"].values()
    assert all(10 < found["psnr"] < 60 and 0 < found["ssim"] <= 1 for found in figures.values())
    held_out, validated = (table.markdown() for table in tables(record))
    assert "PSNR: without ray transformer and target colour | PSNR: with every part" in held_out
    assert "| without ray transformer and target colour | 20.00 |" in validated
    assert "| with every part | 21.00 |" in validated
