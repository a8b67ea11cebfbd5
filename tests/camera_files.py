"""Write small photographs with EXIF and XMP as cameras do, for tests of reading and of quality."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from shared_data import SHARED

from tidefield.survey.io.photographs import read_survey
from tidefield.survey.survey import Photograph, Survey

PHOTOGRAPHS = SHARED / "photographs"
BRIGHTON = (46.8426, -91.9946)
DJI = {"Make": "DJI", "Model": "FC300S"}


def real_survey(name: str) -> Path:
    """The folder of a real survey; skips the test where it is not there."""
    if not (PHOTOGRAPHS / name).is_dir():
        pytest.skip(f"the survey {name} is not on this machine")
    return (PHOTOGRAPHS / name).resolve()


def texture(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A random texture with the spectrum of natural ground."""
    width, height = size
    generator = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(generator.normal(size=(height, width)))
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    spectrum /= np.maximum(frequency, 1 / max(size)) ** 1.2
    spectrum[0, 0] = 0
    levels = np.fft.irfft2(spectrum, (height, width))
    levels = 110 + 35 * levels / levels.std()
    return np.clip(np.stack([levels * 1.1, levels, levels * 0.8], axis=-1), 0, 255).astype(np.uint8)


def exif(
    tags: Mapping[int, object] | None = None,
    gps: Mapping[int, object] | None = None,
    place: tuple[float, float] | None = None,
    height_m: float | None = None,
) -> Image.Exif:
    """EXIF with these tags, and with a position in degrees."""
    picture_tags = (Base.Make, Base.Model, Base.Orientation, Base.DateTime)
    blocks: dict[IFD, dict[int, object]] = {IFD.Exif: {}, IFD.GPSInfo: {}}
    table = Image.Exif()
    for tag, value in (tags or {}).items():
        (table if tag in picture_tags else blocks[IFD.Exif])[tag] = value
    here = blocks[IFD.GPSInfo]
    if place is not None:
        for tag, value, signs in ((GPS.GPSLatitude, place[0], "NS"), (GPS.GPSLongitude, place[1], "EW")):
            degrees, rest = divmod(abs(value), 1)
            minutes, rest = divmod(rest * 60, 1)
            here[tag - 1], here[tag] = signs[value < 0], (degrees, minutes, round(rest * 60, 5))
    if height_m is not None:
        here[GPS.GPSAltitudeRef], here[GPS.GPSAltitude] = bytes([height_m < 0]), abs(height_m)
    here.update(gps or {})
    for block, values in blocks.items():
        if values:
            table[block] = values
    return table


def xmp(properties: Mapping[str, str], inner: str = "") -> bytes:
    """An XMP packet of DJI's and Pix4D's properties, the latter named "Camera:..."."""
    attributes = "".join(
        f' {name if ":" in name else f"drone-dji:{name}"}="{value}"' for name, value in properties.items()
    )
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:Camera="http://pix4d.com/camera/1.0/"'
        f"{attributes}>{inner}</rdf:Description></rdf:RDF></x:xmpmeta>"
        '<?xpacket end="w"?>'
    ).encode()


def photograph(
    path: Path,
    size: tuple[int, int] = (64, 48),
    table: Image.Exif | None = None,
    packet: bytes = b"",
    pixels: np.ndarray | None = None,
) -> Path:
    """Write a photograph; its format is that of the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(texture(size, len(path.name)) if pixels is None else pixels)
    options = {"quality": 95, "xmp": packet} if path.suffix.lower().startswith(".j") else {}
    picture.save(path, exif=(Image.Exif() if table is None else table).tobytes(), **options)
    return path


def survey_folder(folder: Path, count: int = 4, place: tuple[float, float] | None = BRIGHTON) -> Path:
    """A folder of a few small photographs some metres apart."""
    for index in range(count):
        here = place and (place[0] + 1e-4 * index, place[1])
        photograph(folder / f"DJI_{index:04d}.JPG", table=exif(place=here, height_m=200))
    return folder


def one(folder: Path, **given) -> Photograph:
    """Write a photograph and read it as one of a survey of three."""
    survey_folder(folder, count=2, place=None)
    photograph(folder / "this.jpg", **given)
    return named(read_survey(folder), "this.jpg")


def named(survey: Survey, name: str) -> Photograph:
    return next(photograph for photograph in survey.photographs if photograph.name == name)
