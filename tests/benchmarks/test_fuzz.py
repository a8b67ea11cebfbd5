"""Campaigns of damaged files: what is damaged, what counts as a finding, and that every reader takes part."""

import ctypes
import json
import sys
import time
from pathlib import Path
from random import Random

import pytest

from benchmarks import fuzz
from benchmarks.fuzz import measure_fuzz
from benchmarks.mutations import mutate
from benchmarks.readers import CPU_SECONDS, READERS, Reader
from benchmarks.robustness import robustness
from tidefield.errors import RunError, SceneError
from tidefield.files import read_json, write_json

linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
JSON = json.dumps({"a": [1.5, {"b": "c"}], "d": 3}).encode()


def test_damage_depends_on_the_generator_alone_and_changes_every_file():
    for content in (JSON, b"EPSG:4326\na.jpg 1 2\nb.jpg 3 4\n", bytes(range(256))):
        first, second = ([mutate(content, Random(k)) for k in range(200)] for _ in range(2))
        assert first == second
        assert content not in first
        assert len(set(first)) > 150


def make_seeds(folder: Path) -> None:
    (folder / "seed").mkdir(parents=True)
    (folder / "seed" / "file").write_bytes(b"whole")


def is_whole(folder: Path) -> bool:
    return (folder / "file").read_bytes() == b"whole"


def accept(folder: Path) -> None:
    pass


def refuse(folder: Path) -> None:
    if not is_whole(folder):
        raise SceneError("damaged")


def fail(folder: Path) -> None:
    if not is_whole(folder):
        raise KeyError("unexpected")


def end(folder: Path) -> None:
    if not is_whole(folder):
        ctypes.string_at(0)  # a segmentation fault


def compute(folder: Path) -> None:
    end = time.monotonic() + 60
    while not is_whole(folder) and time.monotonic() < end:
        pass


def fill_memory(folder: Path) -> None:
    if not is_whole(folder):
        assert bytearray(b"x") * (fuzz.MOST_BYTES + (1 << 26))


PLANTED = {function.__name__: function for function in (accept, refuse, fail, end, compute, fill_memory)}


@pytest.mark.thorough
@linux
def test_a_finding_is_an_error_an_end_or_too_much_time_or_memory_and_does_not_end_the_campaign(tmp_path: Path):
    readers = [
        Reader(name, "seed", ("file",), read, cpu_seconds=1.0 if read is compute else CPU_SECONDS)
        for name, read in PLANTED.items()
    ]
    counts = measure_fuzz(readers, 0.006, 0, tmp_path / "kept", tmp_path, make_seeds)
    assert counts["accept"].accepted == counts["accept"].files > 0
    assert counts["refuse"].refused > 0
    kinds = {name: {place.partition(":")[0] for place in count.findings} for name, count in counts.items()}
    assert kinds == {
        **{"accept": set(), "refuse": set(), "fail": {"error"}, "end": {"end"}},
        **{"compute": {"time"}, "fill_memory": {"memory"}},
    }
    kept = {path.relative_to(tmp_path / "kept").parts[0] for path in tmp_path.glob("kept/*/*/file")}
    assert kept == {"fail", "end", "compute", "fill_memory"}
    assert "KeyError" in next(tmp_path.glob("kept/fail/*/traceback.txt")).read_text()
    assert read_json(tmp_path / "fuzz.json")["readers"]["fail"]["findings"]


@linux
@pytest.mark.slow
def test_every_reader_accepts_its_whole_files_and_no_damaged_one_is_a_finding(tmp_path: Path):
    counts = measure_fuzz(READERS, 0.5, 1, tmp_path / "kept", None)
    assert all(count.files for count in counts.values())
    assert {name: count.findings for name, count in counts.items() if count.findings} == {}


def test_the_page_shows_the_counts_of_damaged_files_and_of_killed_commands(tmp_path: Path):
    with pytest.raises(RunError, match="holds no counts"):
        robustness(tmp_path, tmp_path / "page.md")
    machine = {"processor": "P", "cores": 2, "memory_bytes": 2**30, "system": "S", "python": "3", "torch": "2"}
    made = {"date": "2026-01-02", "version": "1", "machine": machine}
    count = {"files": 1200, "accepted": 200, "refused": 999, "slowest_seconds": 0.5, "findings": {"error: x": 1}}
    write_json(tmp_path / "fuzz.json", {"command": "fuzz it", "readers": {"PLY": count}, **made})
    killed = {"kills": 20, "identical": 19, "processes": 0, "files": 0}
    write_json(tmp_path / "kills.json", {"command": "kill it", "kills": {"train": killed}, **made})
    robustness(tmp_path, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "|" in line]
    assert ["PLY", "1,200", "200", "999", "1", "0.50"] in rows
    assert ["tidefield train", "20", "19", "0", "0"] in rows
    assert "    fuzz it\n    kill it\n" in page
