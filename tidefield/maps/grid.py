"""Place the cells of a map on the ground: coordinate system, area, ground sampling distance and tiles.

Map coordinates are easting, northing and height in the system of the scene's georeference. A scene without one has a
local frame, which every file says. Within a tile map and scene coordinates are related by an affine function: over the
some 20 m of a tile the curvature of the Earth and of the projection stay below 50 micrometres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError

from tidefield.data.georeference import Georeference
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame, horizontal, in_metres, name_in_metres, parse_crs
from tidefield.render.camera_paths import layout_of

LOCAL_NAME = "local frame of the scene (not georeferenced)"
LOCAL_WKT = f'LOCAL_CS["{LOCAL_NAME}",UNIT["unknown",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
OPEN_DATUMS = ("unknown", "mean sea level")
"""How the words for vertical datums begin that a vertical system may still define."""
FINEST = 0.9
"""Finest cells, as a share of the photographs' ground sampling distance: finer ones would show no more."""
MOST_CELLS = 4_000_000_000
STEEPEST_DEG = 55.0
"""Largest angle from the vertical at which a photograph sees a cell."""
SAMPLES = 128
"""Places along a side, at which level ground is tested for photographs that see it."""
UPRIGHT_DEG = 45.0
"""A local frame is upright if photographs look down its third axis, on average, to this angle."""


@dataclass(frozen=True)
class MapFrame:
    """Map coordinates of a scene.

    Attributes:
        frame: of the georeference; None for a local frame.
        origin_world: the scene's (`Scene.origin_world`).
        rotation: world to the local frame's east, north and up; the identity where the world is upright.
        wkt: the system, compound where the vertical datum is known.
        horizontal_wkt: the same without heights.
        heights: vertical datum, in words.
        metre: horizontal units per metre; 1 in a local frame.
        metre_up: vertical units per metre.
    """

    frame: LocalFrame | None
    origin_world: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    wkt: str
    horizontal_wkt: str
    heights: str
    metre: float = 1.0
    metre_up: float = 1.0

    @property
    def name(self) -> str:
        """The system in words."""
        if self.frame is None:
            return LOCAL_NAME
        crs = parse_crs(self.frame.crs)
        return f"{crs.name} ({self.frame.crs})" if self.frame.epsg else crs.name

    @property
    def unit(self) -> str:
        """Of lengths on the ground, for people."""
        return self._unit(self.metre, 0)

    @property
    def unit_up(self) -> str:
        """Of heights, for people."""
        return self._unit(self.metre_up, -1)

    @property
    def up(self) -> float:
        """Horizontal units in a vertical one."""
        return self.metre / self.metre_up

    def _unit(self, metre: float, axis: int) -> str:
        if self.frame is None:
            return "units"
        return "m" if metre == 1 else parse_crs(self.frame.crs).axis_info[axis].unit_name

    def to_map(self, xyz_scene: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Convert scene coordinates to easting, northing and height."""
        world = xyz_scene + self.origin_world
        return world @ self.rotation.T if self.frame is None else self.frame.to_crs(world)

    def to_scene(self, easting_northing_height: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Convert easting, northing and height to scene coordinates."""
        if self.frame is None:
            return easting_northing_height @ self.rotation - self.origin_world
        return self.frame.from_crs(easting_northing_height) - self.origin_world


def map_frame(scene: Scene, georeference: Georeference | None, heights: str | None = None) -> MapFrame:
    """Choose the map coordinates of a scene.

    Args:
        scene: whose origin counts, and whose vertical where it has no georeference.
        georeference: of the scene.
        heights: vertical system of the heights, such as "EPSG:5701", where the scene does not state it.

    Raises:
        RunError: `heights` is no vertical system, or another one than the scene states, or the scene has no frame to
            which it could belong.
    """
    origin = scene.origin_world.double().numpy()
    frame = None if georeference is None else georeference.frame
    if frame is None:
        if heights is not None:
            raise RunError(
                f"--heights {heights} was given, but the scene is not georeferenced: expected a scene with "
                "coordinates; leave the option out"
            )
        return MapFrame(None, origin, _upright(scene), LOCAL_WKT, LOCAL_WKT, "local, without a datum")
    system = parse_crs(frame.crs)
    plan = horizontal(system)
    stated = system.sub_crs_list[1] if system.is_compound else None
    vertical = _vertical(frame.vertical_datum, heights, stated)
    metre = 1 / plan.axis_info[0].unit_conversion_factor
    metre_up = 1 / vertical.axis_info[0].unit_conversion_factor if vertical is not None and system.is_compound else 1.0
    named = frame.vertical_datum if vertical is None else vertical.name
    whole = plan
    if vertical is not None:
        # Made anew, because GDAL loses the code of a compound system that has one.
        whole = CompoundCRS(f"{plan.name} + {vertical.name}", [plan, vertical])
    return MapFrame(frame, origin, np.eye(3), whole.to_wkt(), plan.to_wkt(), named, metre, metre_up)


def _vertical(datum: str, given: str | None, stated: CRS | None = None) -> CRS | None:
    """The vertical system that is stated or given, or that has the datum's name; None where there is none."""
    known = _named(datum) if stated is None else stated
    if given is not None:
        try:
            crs = CRS.from_user_input(given)
        except CRSError as error:
            raise RunError(f"--heights {given} was given: expected a vertical system, such as EPSG:5701") from error
        if not crs.is_vertical:
            raise RunError(f"--heights {given} is {crs.name}: expected a vertical system, such as EPSG:5701")
        other = not datum.startswith(OPEN_DATUMS) if known is None else _datum_name(known) != _datum_name(crs)
        if other:
            raise RunError(
                f"--heights {given} is {crs.name}, but the scene's heights are over {datum}: expected the option only "
                "where their vertical datum is not known; leave it out, and convert the map's files (gdalwarp -t_srs "
                "with a compound system)"
            )
        if stated is not None:
            return stated
        if not in_metres(crs):
            raise RunError(
                f"--heights {given} is {crs.name}, in {crs.axis_info[0].unit_name}: expected a system in metres, which "
                "the heights of the scene are in; give that of the same datum"
            )
        return crs
    return known


def _named(datum: str) -> CRS | None:
    """EPSG's vertical system in metres of a name; scenes have heights in metres, whatever their control was in."""
    names = {info.name: info.code for info in query_crs_info(auth_name="EPSG", pj_types=PJType.VERTICAL_CRS)}
    code = names.get(name_in_metres(datum))
    found = None if code is None else CRS.from_epsg(int(code))
    return found if found is not None and in_metres(found) else None


def _datum_name(vertical: CRS) -> str:
    return vertical.name if vertical.datum is None else vertical.datum.name


def _upright(scene: Scene) -> Float64[np.ndarray, "3 3"]:
    """Rotation of a world whose third axis is not up; the identity where it is, to `UPRIGHT_DEG`."""
    ahead = scene.cameras.forward_world[list(scene.train)].double().mean(0).numpy()
    if -ahead[2] > math.cos(math.radians(UPRIGHT_DEG)) * np.linalg.norm(ahead):
        return np.eye(3)
    up = np.asarray(layout_of(scene).up, dtype=np.float64)
    east = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


@dataclass(frozen=True)
class Grid:
    """Cells of a map, row 0 in the north.

    Attributes:
        frame: map coordinates.
        west, north: of the outer corner of the first cell; multiples of the cell, so that maps of several surveys
            have the same cells.
        cell: side of a cell, in horizontal units.
        columns, rows: of cells.
        height: a height in the middle of the survey, where distances hold.
    """

    frame: MapFrame
    west: float
    north: float
    cell: float
    columns: int
    rows: int
    height: float

    @property
    def cell_up(self) -> float:
        """Side of a cell, in the unit of heights."""
        return self.cell / self.frame.up

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine coefficients from column and row to easting and northing, in rasterio's order."""
        return self.cell, 0.0, self.west, 0.0, -self.cell, self.north

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north."""
        return self.west, self.north - self.rows * self.cell, self.west + self.columns * self.cell, self.north

    def tiles(self, side: int, margin: int) -> list[Tile]:
        """Cut the grid into tiles of side x side cells, row by row, each with a margin around it."""
        return [
            Tile(self, row - margin, column - margin, side + 2 * margin, margin)
            for row in range(0, self.rows, side)
            for column in range(0, self.columns, side)
        ]

    def coarser(self, factor: int) -> Grid:
        """The same area in cells that are `factor` times as large."""
        columns, rows = -(-self.columns // factor), -(-self.rows // factor)
        return Grid(self.frame, self.west, self.north, self.cell * factor, columns, rows, self.height)


def ground_sampling_distance(scene: Scene) -> float:
    """Median ground sampling distance of a scene's photographs, in scene units.

    Raises:
        RunError: the scene has no sparse points.
    """
    if scene.points is None or not len(scene.points.xyz_world):
        raise RunError(
            f"{scene.root} has no sparse points: expected a scene with some, from which the surface is searched; "
            "prepare it with `tidefield prepare`"
        )
    points = scene.points.xyz_world[:: max(1, len(scene.points.xyz_world) // 4000)]
    each = []
    for index in range(0, len(scene.names), max(1, len(scene.names) // 500)):
        camera = scene.cameras[index]
        uv, z = camera.project(points)
        inside = (z[0] > 0) & (uv[0] > 0).all(-1) & (uv[0] < camera.size_px[0]).all(-1)
        if inside.any():
            each.append(float(z[0][inside].median() / camera.focal_px.mean()))
    return float(np.median(each))


def make_grid(
    frame: MapFrame, scene: Scene, gsd_m: float | None, bounds: tuple[float, float, float, float] | None = None
) -> Grid:
    """Choose the cells of a scene's map.

    Args:
        frame: map coordinates.
        scene: at the size that photographs are matched at.
        gsd_m: side of a cell in metres (in a local frame, in its units); the photographs' median ground sampling
            distance, rounded up to two digits, if not given.
        bounds: west, south, east and north of the map; where at least two photographs see the ground if not given.

    Raises:
        RunError: cells would be finer than the photographs, too many, or nowhere near the survey.
    """
    photographs = ground_sampling_distance(scene)
    unit = "m" if frame.frame else "units"
    if gsd_m is not None and not FINEST * photographs <= gsd_m < math.inf:
        raise RunError(
            f"--gsd {gsd_m:g} was asked for, but the photographs show {photographs:.4g} {unit} per pixel: expected at "
            f"least {FINEST * photographs:.4g}; finer cells would show no more"
        )
    cell = (gsd_m if gsd_m is not None else _rounded_up(photographs)) * frame.metre
    seen = _seen_bounds(frame, scene)
    height = seen[4]
    if bounds is None:
        bounds = seen[:4]
    elif bounds[0] >= seen[2] or bounds[2] <= seen[0] or bounds[1] >= seen[3] or bounds[3] <= seen[1]:
        raise RunError(
            f"the area lies at {bounds[0]:.1f} to {bounds[2]:.1f} east and {bounds[1]:.1f} to {bounds[3]:.1f} north, "
            f"the survey at {seen[0]:.1f} to {seen[2]:.1f} and {seen[1]:.1f} to {seen[3]:.1f}: expected an area within "
            "the survey; check its coordinate system"
        )
    else:
        bounds = (max(bounds[0], seen[0]), max(bounds[1], seen[1]), min(bounds[2], seen[2]), min(bounds[3], seen[3]))
    west, north = math.floor(bounds[0] / cell + 1e-9), math.ceil(bounds[3] / cell - 1e-9)
    columns, rows = math.ceil(bounds[2] / cell - 1e-9) - west, north - math.floor(bounds[1] / cell + 1e-9)
    columns, rows = max(2, columns), max(2, rows)  # contours and slopes need two
    if columns * rows > MOST_CELLS:
        raise RunError(
            f"{columns} x {rows} cells were asked for: expected at most {MOST_CELLS:,}; choose a larger --gsd or "
            "an --area"
        )
    return Grid(frame, west * cell, north * cell, cell, columns, rows, height)


def _rounded_up(value: float) -> float:
    """Two significant digits, not less than the value."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / power - 1e-6) * power


def _seen_bounds(frame: MapFrame, scene: Scene) -> tuple[float, float, float, float, float]:
    """West, south, east and north of what at least two photographs see, and the points' median height.

    That is of the sparse points and, because water has none, of level ground at their median height. A hundredth of the
    points may lie outside on each side: they are outliers, or seen against the horizon. The photographs' rims beyond
    the points are covered by a margin.
    """
    assert scene.points is not None
    xyz = frame.to_map(scene.points.xyz_world.double().numpy())
    low, high = np.percentile(xyz[:, :2], [0.5, 99.5], axis=0)
    margin = 0.02 * (high - low) + 1e-9
    low, high = low - margin, high + margin
    height = float(np.median(xyz[:, 2]))
    position = frame.to_map(scene.cameras.position_world.double().numpy())
    above = float(np.median(position[:, 2])) - height
    reach = max(above, 0.0) * frame.up * math.tan(math.radians(STEEPEST_DEG))
    corners = np.stack([position[:, :2].min(0) - reach, position[:, :2].max(0) + reach])
    east, north = (corners[0, k] + (np.arange(SAMPLES) + 0.5) / SAMPLES * np.ptp(corners[:, k]) for k in (0, 1))
    places = np.stack([*np.meshgrid(east, north), np.full((SAMPLES, SAMPLES), height)], -1).reshape(-1, 3)
    ground = torch.from_numpy(frame.to_scene(places)).float()
    count = np.zeros(len(places), int)
    for index in range(len(scene.names)):
        near = np.flatnonzero(np.hypot(*(places[:, :2] - position[index, :2]).T) <= reach)
        camera = scene.cameras[index]
        uv, z = camera.project(ground[near])
        inside = (z[0] > 0) & (uv[0] > 0).all(-1) & (uv[0] < camera.size_px[0]).all(-1)
        count[near[inside.numpy()]] += 1
    seen = places[count >= 2, :2]
    if len(seen):
        between = np.ptp(corners, axis=0) / SAMPLES
        low, high = np.minimum(low, seen.min(0) - between), np.maximum(high, seen.max(0) + between)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1]), height


@dataclass(frozen=True)
class Tile:
    """A square of cells with a margin; parts of it may lie outside of the grid.

    Attributes:
        row, column: of the first cell, margin included.
        side: cells along a side, margin included.
        margin: cells around the part that belongs to this tile alone.
    """

    grid: Grid
    row: int
    column: int
    side: int
    margin: int

    @property
    def name(self) -> str:
        return f"{self.row + self.margin}_{self.column + self.margin}"

    @property
    def centre(self) -> tuple[float, float]:
        """Easting and northing of the middle."""
        half = self.side / 2
        return self.grid.west + (self.column + half) * self.grid.cell, self.grid.north - (
            self.row + half
        ) * self.grid.cell

    @cached_property
    def affine(self) -> Float64[np.ndarray, "3 4"]:
        """Matrix from (east, north, height - `Grid.height`, 1), from the middle of the tile, to scene coordinates."""
        east, north = self.centre
        half = self.side * self.grid.cell / 2
        height = self.grid.height
        offsets = half * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        points = self.grid.frame.to_scene(np.array([[east, north, height]]) + offsets)
        return np.column_stack([*((points[1:4] - points[4:]) / (2 * half)), points[0]])

    def offsets(self, pad: int = 0) -> tuple[Float[np.ndarray, "1 n"], Float[np.ndarray, "n 1"]]:
        """East and north of cell centres from the middle of the tile.

        Args:
            pad: cells added on each side.
        """
        count = self.side + 2 * pad
        along = ((np.arange(count) - (count - 1) / 2) * self.grid.cell).astype(np.float32)
        return along[None], -along[:, None]

    def window(self) -> tuple[slice, slice, slice, slice]:
        """Rows and columns of the grid that the tile covers with its margin, and the same of the tile's own arrays."""
        top, left = max(0, -self.row), max(0, -self.column)
        bottom = min(self.side, self.grid.rows - self.row)
        right = min(self.side, self.grid.columns - self.column)
        return (
            slice(self.row + top, self.row + bottom),
            slice(self.column + left, self.column + right),
            slice(top, bottom),
            slice(left, right),
        )


def feather(side: int, margin: int) -> Float[np.ndarray, "n n"]:
    """Weights of a tile's cells, which add up to 1 with those of its neighbours: linear across both margins."""
    along = np.clip((np.arange(side) + 0.5) / max(2 * margin, 1), 0, 1)
    along = np.minimum(along, along[::-1]).astype(np.float32) if margin else np.ones(side, np.float32)
    return along[:, None] * along[None]
