"""A survey of thousands of photographs, made of a small one: does memory stay flat?

The photographs are reduced and copied; every copy of the survey lies kilometres from the others and was flown hours
after the one before, so that the real stages choose pairs, match, place and report as for one huge survey.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from tidefield.compare.record import Runner, tidefield
from tidefield.files import read_json, write_json
from tidefield.machine import describe

WIDTH = 400
APART_DEG = 0.05
LATER = timedelta(hours=3)
EXIF_TIME = "%Y:%m:%d %H:%M:%S"


def measure_many(source: Path, runs: Path, count: int, run: Runner, say: Callable[[str], object]) -> dict[str, Any]:
    """Prepare `count` photographs; what it took is kept in RUNS/many.json, and is not measured again."""
    kept = read_json(runs / "many.json")
    if kept is not None:
        return kept
    with tempfile.TemporaryDirectory() as folder:
        say(f"{count} photographs from {source}")
        _copies(source, Path(folder) / "card", count)
        took = run(tidefield("prepare", Path(folder) / "card", Path(folder) / "scene"), {})
        report = read_json(Path(folder) / "scene" / "report.json")
    steps = report["processing_statistics"]["steps_times"]
    record = {"photographs": count, "steps_times": steps, **asdict(took), **describe()}
    write_json(runs / "many.json", record)
    return record


def _flown_later(exif: Image.Exif, copy: int) -> None:
    """Move a photograph's time on by a few hours for each copy."""
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    time = tags.get(ExifTags.Base.DateTimeOriginal)
    if isinstance(time, str):
        later = datetime.strptime(time, EXIF_TIME) + copy * LATER
        tags[ExifTags.Base.DateTimeOriginal] = later.strftime(EXIF_TIME)


def _copies(source: Path, folder: Path, count: int) -> None:
    """Reduced photographs, and gps.csv with the copies' places side by side."""
    from tidefield.survey.io.photographs import read_survey

    folder.mkdir(parents=True)
    photographs = [photograph for photograph in read_survey(source).photographs if photograph.position is not None]
    lines = ["image_name,lat,lon,gps_height"]
    for k in range(count):
        copy, number = divmod(k, len(photographs))
        photograph = photographs[number]
        place = photograph.position
        assert place is not None, "those without a position were left out"
        name = f"{copy:03d}_{Path(photograph.name).name}"
        with Image.open(photograph.path) as picture:
            height = round(picture.height * WIDTH / picture.width)
            exif = picture.getexif()
            exif.pop(ExifTags.IFD.GPSInfo, None)  # gps.csv says where the copies are
            _flown_later(exif, copy)
            picture.resize((WIDTH, height), Image.Resampling.LANCZOS).save(folder / name, quality=92, exif=exif)
        row, column = divmod(copy, 20)
        latitude, longitude = place.latitude_deg + APART_DEG * row, place.longitude_deg + APART_DEG * column
        lines.append(f"{name},{latitude:.8f},{longitude:.8f},{place.height_m:.2f}")
    (folder / "gps.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
