"""Find what a survey has: a surface, its standard errors, an orthophoto and a cloud, in a folder or as a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tidefield.change.clouds import Cloud, default_cell, in_system, read_cloud, require_system, write_surface
from tidefield.change.shift import is_picture
from tidefield.change.surfaces import ChangeError, Surface, date_in, open_surface, opened, require_one_datum

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
) -> Pair:
    """Open two surveys; of point clouds surfaces are made, the mean height of the points in each cell.

    Args:
        work: folder for the surfaces of clouds.
        cell_m: of these; ten points to a cell if None.
        with_clouds: read the clouds of folders, too.
        registered: whether stable ground takes out what their ellipsoids differ by.

    Raises:
        ChangeError: one has no surface, only one is a cloud, folders have no clouds, or vertical datums differ.
    """
    if is_cloud(earlier) != is_cloud(later):
        cloud = earlier if is_cloud(earlier) else later
        raise ChangeError(f"{cloud} is a point cloud, the other survey is none: expected two surfaces or two clouds")
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
            paths = [survey.cloud for survey in surveys]
            if paths[0] is None or paths[1] is None:
                raise ChangeError("--m3c2 was given, but a survey has no point cloud: expected folders with clouds")
            clouds = _both(paths[0], paths[1], registered)
            for k, cloud in enumerate(clouds):
                require_system(cloud, surveys[0].crs)
                surveys[k] = replace(surveys[k], remarks=[*surveys[k].remarks, *cloud.remarks])
        return Pair(*_distinguished(surveys[0], surveys[1], earlier, later), clouds)
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
    return Pair(*_distinguished(surfaces[0], surfaces[1], earlier, later), clouds)


def _alike(earlier: Path, later: Path) -> tuple[str, ...]:
    """The surfaces of folders that both surveys have one of: of one kind if they do, surface models before terrain."""
    for kind in (_SURFACE, _TERRAIN):
        names = tuple(name for name in SURFACES if Path(name).stem == kind)
        other = {_SURFACE, _TERRAIN} - {kind}
        if all(first_of(path, names) if path.is_dir() else path.stem not in other for path in (earlier, later)):
            return names
    return SURFACES


def _distinguished(one: Surface, two: Surface, of_one: Path, of_two: Path) -> tuple[Surface, Surface]:
    """Two surveys; if their files are called the same, with as many of the folders above in their names as differ."""
    if one.name != two.name or one.date:
        return one, two
    first, second = of_one.resolve().parts, of_two.resolve().parts
    depth = next((k for k in range(1, 1 + min(len(first), len(second))) if first[-k] != second[-k]), 1)
    return (
        replace(one, source="/".join((*first[-depth:-1], one.name))),
        replace(two, source="/".join((*second[-depth:-1], two.name))),
    )


def _both(earlier: Path, later: Path, registered: bool) -> tuple[Cloud, Cloud]:
    first, second = read_cloud(earlier), read_cloud(later)
    require_one_datum([(cloud.path, cloud.vertical_datum) for cloud in (first, second)], registered)
    return first, in_system(second, first.crs)


def first_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first of some files that a folder has."""
    return next((folder / name for name in names if (folder / name).is_file()), None)
