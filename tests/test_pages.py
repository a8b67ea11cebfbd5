"""What the reports have in common."""

import pytest

from tidefield.pages import command_line


def test_a_report_names_files_and_no_folders_of_this_machine(monkeypatch: pytest.MonkeyPatch):
    words = ["map", "/home/ada/flats/2026 may", "maps/may", "--weights=/home/ada/own.safetensors", "--gsd", "0.05"]
    monkeypatch.setattr("sys.argv", ["/opt/bin/tidefield", *words, "s3://my-bucket/survey"])
    expected = "tidefield map '2026 may' may --weights=own.safetensors --gsd 0.05 survey"
    assert command_line() == expected
