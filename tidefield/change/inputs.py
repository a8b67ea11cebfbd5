"""Find what a survey has: a surface, its standard errors, an orthophoto and a cloud, in a folder or as a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tidefield.change.clouds import (
    Cloud,
    default_cell,
    in_system,
    look_at_cloud,
    read_cloud,
    require_system,
    write_surface,
)
from tidefield.change.shift import is_picture
from tidefield.change.surfaces import (
    ChangeError,
    Surface,
    compared_grid,
    date_in,
    open_surface,
    opened,
    require_one_datum,
)

FILLED, CLASSES = "filled.tif", "classes.tif"
"""Of `tidefield map --fill`, and of every map, next to the surface."""
_SURFACE, _TERRAIN = "dsm", "dtm"
SURFACES = ("odm_dem/dsm.tif", "odm_dem/dtm.tif", "dsm.tif", "dtm.tif")
ORTHOPHOTOS = ("odm_orthophoto/odm_orthophoto.tif", "orthophoto.tif", "ortho.tif")
CLOUDS = tuple(
    f"{folder}{name}.{ending}"
    for folder, name in (("odm_georeferencing/", "odm_georeferenced_model"), ("", "cloud"))
    for ending in ("laz", "las")
)
_OTHER_CLOUDS = (".ply", ".pcd", ".e57", ".pts", ".ptx")


def open_survey(path: Path, date: str | None = None, surfaces: tuple[str, ...] = SURFACES) -> Surface:
    """Open a survey: a GeoTIFF of heights, or a folder of `tidefield map` or ODM.

    Args:
        date: of the survey, YYYY-MM-DD; None takes it from its files or their names.
        surfaces: of a folder, the first that is there.

    Raises:
        ChangeError: there is no surface.
    """
    if is_cloud(path):
        raise ChangeError(f"{path} is a point cloud: expected a surface; compare it with another cloud")
    if path.suffix.lower() in _OTHER_CLOUDS:
        raise ChangeError(
            f"{path} is a point cloud of another format: expected LAS or LAZ; convert it (pdal translate, CloudCompare)"
        )
    if not path.is_dir():
        # Another surface in that folder is none of the map's.
        mapped = path.name in {Path(name).name for name in SURFACES}
        found = open_surface(path, date)
        return _with_marks(found) if mapped else found
    surface = first_of(path, surfaces)
    if surface is None:
        raise ChangeError(
            f"{path} has no surface: expected one of {', '.join(SURFACES)}, as `tidefield map` and ODM write them; "
            "name a GeoTIFF of heights"
        )
    name = path.resolve().name
    found = open_surface(surface, date or date_in(name))
    picture, remarks = first_of(path, ORTHOPHOTOS), []
    if picture is not None:
        with opened(picture) as dataset:
            if not is_picture(dataset):
                remarks.append(
                    f"{picture.name} of {name} has {dataset.count} bands of {dataset.dtypes[0]}, not red, green and "
                    "blue: it is not used"
                )
                picture = None
    return replace(
        _with_marks(found),
        orthophoto=picture,
        cloud=first_of(path, CLOUDS),
        source=name,
        remarks=[*found.remarks, *remarks],
    )


def _with_marks(surface: Surface) -> Surface:
    """A surface of a map with the rasters next to it that tell which cells are no measurements of the ground."""
    folder = surface.path.parent
    return replace(surface, filled=first_of(folder, (FILLED,)), classes=first_of(folder, (CLASSES,)))


def is_cloud(path: Path) -> bool:
    """Whether a file is named as a point cloud."""
    return path.suffix.lower() in (".las", ".laz") and not path.is_dir()


@dataclass(frozen=True)
class Pair:
    """Two surveys, opened.

    Attributes:
        clouds: of both, in the earlier one's system; None where they are not compared as clouds.
    """

    earlier: Surface
    later: Surface
    clouds: tuple[Cloud, Cloud] | None


def open_pair(
    earlier: Path,
    later: Path,
    work: Path,
    dates: tuple[str | None, str | None] = (None, None),
    cell_m: float | None = None,
    with_clouds: bool = False,
    registered: bool = True,
    names: Sequence[str] | None = None,
) -> Pair:
    """Open two surveys; of point clouds surfaces are made, the mean height of the points in each cell.

    Args:
        work: folder for the surfaces of clouds.
        cell_m: of these; ten points to a cell if None.
        with_clouds: read the clouds of folders, too.
        registered: whether stable ground takes out what their ellipsoids differ by.
        names: of the surveys, for those without a date; by their files, and the folders above, if None.

    Raises:
        ChangeError: one has no surface, only one is a cloud, folders have no clouds, or vertical datums differ.
    """
    _require_one_kind(earlier, later)
    if not is_cloud(earlier):
        alike = _alike(earlier, later)
        surveys = [open_survey(path, date, alike) for path, date in zip((earlier, later), dates, strict=True)]
        if {survey.path.stem for survey in surveys} == {_SURFACE, _TERRAIN}:
            remark = (
                f"one survey is a surface model ({_SURFACE}.tif), the other a terrain model ({_TERRAIN}.tif): what "
                "stands on the ground counts as change"
            )
            surveys[0] = replace(surveys[0], remarks=[*surveys[0].remarks, remark])
        clouds = None
        if with_clouds:
            first, second = _clouds_of(surveys)
            clouds = _both(first, second, registered)
            for k, cloud in enumerate(clouds):
                require_system(cloud, surveys[0].crs)
                surveys[k] = replace(surveys[k], remarks=[*surveys[k].remarks, *cloud.remarks])
        one, other = _named(surveys, (earlier, later), names)
        return Pair(one, other, clouds)
    clouds = _both(earlier, later, registered)
    cell = cell_m or max(default_cell(cloud) for cloud in clouds)
    surfaces = []
    for name, cloud, date in zip(("earlier", "later"), clouds, dates, strict=True):
        path = work / f"{name}.tif"
        write_surface(cloud, cell, path)
        opened = open_surface(path, date or date_in(cloud.path.stem))
        surfaces.append(
            replace(opened, source=cloud.path.name, datum=cloud.vertical_datum, remarks=list(cloud.remarks))
        )
    one, other = _named(surfaces, (earlier, later), names)
    return Pair(one, other, clouds)


def _alike(earlier: Path, later: Path) -> tuple[str, ...]:
    """The surfaces of folders that both surveys have one of: of one kind if they do, surface models before terrain."""
    for kind in (_SURFACE, _TERRAIN):
        names = tuple(name for name in SURFACES if Path(name).stem == kind)
        other = {_SURFACE, _TERRAIN} - {kind}
        if all(first_of(path, names) if path.is_dir() else path.stem not in other for path in (earlier, later)):
            return names
    return SURFACES


def look_at_series(
    paths: Sequence[Path],
    dates: Sequence[str | None],
    cell_m: float | None = None,
    with_clouds: bool = False,
    registered: bool = True,
) -> tuple[list[str], list[str | None]]:
    """Find the names and dates of a series of surveys, and what would stop it, before any is compared.

    Args:
        dates, cell_m, with_clouds, registered: as `open_pair` has them.

    Returns:
        the names and the dates; surveys without a date have names of their own.

    Raises:
        ChangeError: a survey cannot be read, or not be compared with the first or the one before.
    """
    for path in paths[1:]:
        _require_one_kind(paths[0], path)
    surveys, found = [], list(dates)
    if is_cloud(paths[0]):
        clouds = [look_at_cloud(path) for path in paths]
        found = [date or date_in(path.stem) for date, path in zip(dates, paths, strict=True)]
        names = [date or path.name for date, path in zip(found, paths, strict=True)]
    else:
        surveys = [open_survey(path, date) for path, date in zip(paths, dates, strict=True)]
        clouds = [look_at_cloud(path) for path in _clouds_of(surveys)] if with_clouds else []
        names, found = [survey.name for survey in surveys], [survey.date for survey in surveys]
    for end in range(1, len(paths)):
        for start in {0, end - 1}:
            if surveys:
                compared_grid(surveys[start], surveys[end], cell_m, registered)
            if clouds:
                require_system(clouds[start], clouds[end].crs)
                require_one_datum([(clouds[k].path, clouds[k].vertical_datum) for k in (start, end)], registered)
    return _distinguished(names, found, paths), found


def _require_one_kind(one: Path, other: Path) -> None:
    if is_cloud(one) != is_cloud(other):
        cloud = one if is_cloud(one) else other
        raise ChangeError(f"{cloud} is a point cloud, the other survey is none: expected two surfaces or two clouds")


def _clouds_of(surveys: Sequence[Surface]) -> list[Path]:
    clouds = [survey.cloud for survey in surveys if survey.cloud is not None]
    if len(clouds) < len(surveys):
        raise ChangeError("--m3c2 was given, but a survey has no point cloud: expected folders with clouds")
    return clouds


def _named(surveys: Sequence[Surface], paths: Sequence[Path], names: Sequence[str] | None) -> list[Surface]:
    """Surveys that are named so, unless they have dates."""
    if names is None:
        names = _distinguished([survey.name for survey in surveys], [survey.date for survey in surveys], paths)
    return [
        survey if survey.date or survey.name == name else replace(survey, source=name)
        for survey, name in zip(surveys, names, strict=True)
    ]


def _distinguished(names: Sequence[str], dates: Sequence[str | None], paths: Sequence[Path]) -> list[str]:
    """Names; surveys without a date that are called the same have as many of the folders above in theirs as differ."""
    found, parts = list(names), [path.resolve().parts for path in paths]
    for name in set(names):
        same = [k for k in range(len(names)) if names[k] == name and not dates[k]]
        depth = 1
        while len({parts[k][-depth:] for k in same}) < len({parts[k] for k in same}):
            depth += 1
        for k in same:
            found[k] = "/".join((*parts[k][-depth:-1], name))
    return found


def _both(earlier: Path, later: Path, registered: bool) -> tuple[Cloud, Cloud]:
    first, second = read_cloud(earlier), read_cloud(later)
    require_one_datum([(cloud.path, cloud.vertical_datum) for cloud in (first, second)], registered)
    return first, in_system(second, first.crs)


def first_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first of some files that a folder has."""
    return next((folder / name for name in names if (folder / name).is_file()), None)
