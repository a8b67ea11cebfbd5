"""Maps of real surveys, and the time they take next to `prepare`; beside what users of ODM published of one of them.

The surveys have no truth but their receivers' positions: how well a map is placed is how far the photographs' positions
lie from those, and how precise it is, its own standard error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tyro.conf import Positional

from benchmarks.maps import made_map
from benchmarks.records import say, show
from tidefield.compare.tables import Table
from tidefield.files import read_json, write_json
from tidefield.machine import describe

PUBLISHED = (
    "brighton_beach by ODM 3.5.3, 4000 px (users' reports, 2024; machines not stated)",
    "18", "1.6", "7,050", "1.37 to 1.50", "0.58 to 0.65", "0.18 to 0.38", "-", "64 to 184, in all", "-", "-",
)  # fmt: skip
"""Reports attached to an issue of OpenDroneMap's on GitHub (user-attachments/files/16255978, 16256003 and 16255813): X
and Y joined here. A developer tried settings of SIFT on the original photographs."""


def map_surveys(scenes: Positional[tuple[Path, ...]], runs: Path = Path("runs/map_surveys")) -> None:
    """Map surveys that `tidefield prepare` made, and read what both commands recorded of themselves.

    Args:
        scenes: Scenes of tidefield prepare; times are those of the same machine if it was prepared there.
        runs: Folder for the maps and map_surveys.json.
    """
    record: dict[str, Any] = {**describe(), "surveys": {}}
    for scene in scenes:
        say(f"{scene.name}: map")
        made, prepared = made_map(scene, runs / scene.name), read_json(scene / "report.json")
        assert prepared is not None, f"{scene} is not of `tidefield prepare`"
        errors = prepared["gps_errors"]
        record["surveys"][scene.name] = {
            "photographs": prepared["reconstruction_statistics"]["reconstructed_shots_count"],
            "gsd": made["grid"]["cell"],
            "area": made["area"],
            "points": made["points"],
            "horizontal": errors["rms_horizontal"],
            "vertical": errors["rms_vertical"],
            "sigma": made["sigma_median"],
            "prepare_seconds": prepared["processing_statistics"]["steps_times"]["Total Time"],
            "map_seconds": made["seconds"],
        }
    write_json(runs / "map_surveys.json", record)
    show([table(record)])


def table(record: dict[str, Any]) -> Table:
    """A row for each survey, and the published one."""
    columns = (
        "survey", "photographs", "cell, cm", "area, m2", "points, million", "off receivers: horizontal, m",
        "vertical, m", "median standard error, cm", "prepare, s", "map, s", "map / prepare",
    )  # fmt: skip
    rows = [
        (
            name,
            f"{found['photographs']}",
            f"{100 * found['gsd']:.1f}",
            f"{found['area']:,.0f}",
            f"{found['points'] / 1e6:.2f}",
            f"{found['horizontal']:.2f}",
            f"{found['vertical']:.2f}",
            f"{100 * found['sigma']:.1f}",
            f"{found['prepare_seconds']:.0f}",
            f"{found['map_seconds']:.0f}",
            f"{found['map_seconds'] / found['prepare_seconds']:.1f}",
        )
        for name, found in record["surveys"].items()
    ]
    return Table("Real surveys", columns, [*rows, PUBLISHED] if "brighton_beach" in record["surveys"] else rows)
