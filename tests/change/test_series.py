"""What the page of a series says of its comparisons."""

import json
from pathlib import Path

from tidefield.change.series import Entry, Since, write_series
from tidefield.change.volumes import Volume


def test_remarks_are_those_of_the_comparisons_they_were_made_on(tmp_path: Path):
    volume = Volume(10.0, 3.0, 4.0, 0.0, 100.0)
    comparisons: list[tuple[Since, int, int]] = [("first", 0, 1), ("step", 0, 1), ("first", 0, 2), ("step", 1, 2)]
    entries = [Entry(*one, "all", what, volume) for one in comparisons for what in ("net", "cut", "fill")]
    remarks = {
        (0, 1): ["heights are rounded"],
        (0, 2): ["heights are rounded"],
        (1, 2): ["heights are rounded", "a & b"],
    }
    write_series(entries, remarks, ["2021", "2022", "2023"], tmp_path, "tidefield change")
    page = (tmp_path / "series.html").read_text()
    assert "<li>heights are rounded</li>" in page
    assert "<li>2022 to 2023: a &amp; b</li>" in page
    of = json.loads((tmp_path / "series.json").read_text())["remarks"]
    assert of["heights are rounded"] == ["2021 to 2022", "2021 to 2023", "2022 to 2023"]
