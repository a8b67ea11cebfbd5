"""Find what a survey has: a surface, its standard errors, an orthophoto and a cloud, in a folder or as a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tidefield.change.surfaces import ChangeError, Surface, open_surface

SURFACES = ("odm_dem/dsm.tif", "odm_dem/dtm.tif", "dsm.tif", "dtm.tif")
ORTHOPHOTOS = ("odm_orthophoto/odm_orthophoto.tif", "orthophoto.tif", "ortho.tif")
CLOUDS = tuple(
    f"{folder}{name}.{ending}"
    for folder, name in (("odm_georeferencing/", "odm_georeferenced_model"), ("", "cloud"))
    for ending in ("laz", "las")
)


def open_survey(path: Path, date: str | None = None) -> Surface:
    """Open a survey: a GeoTIFF of heights, or a folder of `tidefield map` or ODM.

    Args:
        date: of the survey, YYYY-MM-DD; None takes it from its files or their names.

    Raises:
        ChangeError: there is no surface.
    """
    if not path.is_dir():
        return open_surface(path, date)
    surface = first_of(path, SURFACES)
    if surface is None:
        raise ChangeError(
            f"{path} has no surface: expected one of {', '.join(SURFACES)}, as `tidefield map` and ODM write them; "
            "name a GeoTIFF of heights"
        )
    found = open_surface(surface, date)
    return replace(found, orthophoto=first_of(path, ORTHOPHOTOS), cloud=first_of(path, CLOUDS))


def first_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first of some files that a folder has."""
    return next((folder / name for name in names if (folder / name).is_file()), None)
