"""The same place then and now: views of both surveys from one camera, and what differs between them but the light.

The earlier photograph's camera is carried into the later survey through map coordinates and co-registration, so that
both views show the same ground at the same pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from pyproj import CRS, Transformer

from tidefield.change.cover import Cover
from tidefield.change.kinds import GAINED, HIGHER, LOST, LOWER, UNKNOWN, View, colour_kinds
from tidefield.change.light import light_gains, with_light
from tidefield.change.measure import Change
from tidefield.change.surfaces import ChangeError, Grid, values_at
from tidefield.data.georeference import find_georeference
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.geodesy import LocalFrame
from tidefield.maps.grid import MapFrame, map_frame
from tidefield.model.rendering import Render, Rendering
from tidefield.render.stills import MIN_OPACITY, colour_picture

_ARM = 10.0
"""Length of the axes by which a camera's attitude is carried over, in scene units."""
_HIDDEN = 0.05
"""Share of the depth by which the dates' depths may differ before one of the views shows something in front."""


@dataclass(frozen=True)
class Site:
    """A survey's scene, how it is rendered, and its map coordinates."""

    scene: Scene
    render: Render
    frame: MapFrame

    @classmethod
    def of(cls, scene: Scene, render: Render) -> Site:
        return cls(scene, render, map_frame(scene, find_georeference(scene.root, scene.reference)))


def carried(
    camera: Cameras, earlier: Site, later: Site, shift_m: tuple[float, float] = (0.0, 0.0), lift_m: float = 0.0
) -> Cameras:
    """A camera of the earlier scene in the later one, where it sees the same ground.

    Args:
        shift_m: by which the later survey is moved east and north to lie on the earlier one.
        lift_m: what is taken from the later heights.

    Raises:
        ChangeError: one of the scenes has a georeference and the other none, or their systems do not fit together.
    """
    pose = camera.T_world_camera[0].double().numpy()
    points = np.vstack([pose[:, 3], pose[:, 3] + _ARM * pose[:, :3].T])
    one, other = earlier.frame, later.frame
    on_map = _between(one, other)(one.to_map(points))
    on_map -= [shift_m[0] * other.metre, shift_m[1] * other.metre, -lift_m * other.metre_up]
    moved = other.to_scene(on_map)
    u, _, vt = np.linalg.svd(((moved[1:] - moved[0]) / _ARM).T)
    made = torch.from_numpy(np.column_stack([u @ vt, moved[0]])).float()[None]
    return replace(camera, T_world_camera=made, names=())


def require_both_placed(one: LocalFrame | None, other: LocalFrame | None) -> None:
    """Raises: ChangeError when only one of two scenes has a georeference."""
    if (one is None) != (other is None):
        raise ChangeError(
            "one of the scenes is georeferenced, the other is not: expected both in one system; prepare both with "
            "positions or ground control"
        )


def _between(one: MapFrame, other: MapFrame) -> Callable[[Float64[np.ndarray, "N 3"]], Float64[np.ndarray, "N 3"]]:
    """Conversion of easting, northing and height from one map's system to another's."""
    require_both_placed(one.frame, other.frame)
    heights = np.array([1.0, 1.0, other.metre_up / one.metre_up])
    if one.frame is None or one.horizontal_wkt == other.horizontal_wkt:
        return lambda points: points * heights
    to = Transformer.from_crs(CRS.from_wkt(one.horizontal_wkt), CRS.from_wkt(other.horizontal_wkt), always_xy=True)
    return lambda points: (
        np.column_stack([*to.transform(points[:, 0], points[:, 1], errcheck=True), points[:, 2]]) * heights
    )


def choose_camera(change: Change, site: Site) -> str:
    """Name of the photograph that looks at the largest outlined volume, or at the middle where there is none."""
    grid = change.grid
    if change.each:
        number = max(change.each, key=lambda each: each[1].value_m3)[0]
        rows, columns = change.outlines.boxes[number - 1]
    else:
        rows, columns = slice(0, grid.rows), slice(0, grid.columns)
    middle = [
        grid.west_m + (columns.start + columns.stop) / 2 * grid.cell_m,
        grid.north_m - (rows.start + rows.stop) / 2 * grid.cell_m,
    ]
    cameras = site.scene.cameras
    depth = cameras.near_far.mean(1, keepdim=True)
    aim = (cameras.position_world + depth * cameras.forward_world).double().numpy()
    on_map = _to_grid(site.frame, grid)(aim)
    return site.scene.names[int(np.hypot(*(on_map[:, :2] - middle).T).argmin())]


def _to_grid(frame: MapFrame, grid: Grid) -> Callable[[Float64[np.ndarray, "N 3"]], Float64[np.ndarray, "N 3"]]:
    """Conversion of scene coordinates to a change's grid coordinates.

    Raises:
        ChangeError: the scene has a place on the Earth and the surfaces have none, or the other way round.
    """
    if (frame.frame is None) != (grid.crs is None):
        placed, bare = (
            ("the earlier scene", "the surfaces") if grid.crs is None else ("the surfaces", "the earlier scene")
        )
        raise ChangeError(
            f"{placed} lie in a coordinate system, {bare} in none: expected maps of these scenes; make them with "
            "`tidefield map`"
        )
    if frame.frame is None or grid.crs is None:
        return frame.to_map
    system, target = CRS.from_wkt(frame.horizontal_wkt), CRS.from_wkt(grid.crs)
    if system.equals(target, ignore_axis_order=True):
        return frame.to_map
    to = Transformer.from_crs(system, target, always_xy=True)

    def convert(points: np.ndarray) -> np.ndarray:
        own = frame.to_map(points)
        return np.column_stack([*to.transform(own[:, 0], own[:, 1], errcheck=True), own[:, 2]])

    return convert


def make_view(
    change: Change, cover: Cover | None, earlier: Site, later: Site, name: str, width: int | None = None
) -> View:
    """Render both dates from an earlier photograph's camera, and tell what differs.

    Raises:
        SceneError: the earlier scene has no photograph of this name.
    """
    index = earlier.scene.index(name)
    camera = earlier.scene.cameras[index]
    if width is not None:
        camera = camera.resized(width, max(16, round(width * camera.height / camera.width)))
    camera = replace(camera, gain=torch.ones_like(camera.gain), shading=None)
    first, registration = earlier.render(camera), change.errors.registration
    place = _cells(camera, first, earlier.frame, change.grid)
    known = place[np.isfinite(place).all(axis=1)]
    middle = np.median(known, axis=0) if len(known) else np.array(registration.centre_m)
    lift_m = float(registration.lift_at(middle[None])[0])  # a tilt over what one view shows is small
    second = later.render(carried(camera, earlier, later, registration.shift_m, lift_m))
    return _compared(earlier.scene.names[index], first, second, place, change, cover)


def _cells(camera: Cameras, view: Rendering, frame: MapFrame, grid: Grid) -> Float64[np.ndarray, "P 2"]:
    """Easting and northing of what each pixel shows, in the grid's coordinates."""
    rays = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    points = camera.position_world + rays * view.depth.reshape(-1, 1).cpu()
    points = points.double().numpy()
    # Over a view the map is affine to millimetres: it is fitted to some of its points.
    finite = np.isfinite(points).all(axis=1)
    some = points[finite][:: max(1, int(finite.sum()) // 500)]
    if len(some) < 4:
        return np.full((len(points), 2), np.nan)
    middle = some.mean(axis=0)
    design = np.column_stack([some - middle, np.ones(len(some))])
    on_map = _to_grid(frame, grid)(some)[:, :2]
    start = on_map.mean(axis=0)
    solved = np.linalg.lstsq(design, on_map - start, rcond=None)[0]
    return np.column_stack([points - middle, np.ones(len(points))]) @ solved + start


def _compared(
    name: str,
    first: Rendering,
    second: Rendering,
    place: Float64[np.ndarray, "P 2"],
    change: Change,
    cover: Cover | None,
) -> View:
    shape = first.depth.shape
    one, other = colour_picture(first), colour_picture(second)
    depths = [view.depth.detach().float().cpu().numpy() for view in (first, second)]
    seen = np.logical_and.reduce([(v.opacity >= MIN_OPACITY).cpu().numpy() for v in (first, second)])
    with np.errstate(invalid="ignore"):
        seen &= np.abs(depths[1] - depths[0]) < _HIDDEN * depths[0]
    known = values_at(np.isfinite(change.dz), change.grid, place, 0).reshape(shape) > 0
    number = values_at(change.outlines.labels, change.grid, place, 0).reshape(shape)
    sign = np.concatenate([[0], change.outlines.signs])[number]
    planted = np.zeros(shape, int) if cover is None else values_at(cover.classes, cover.grid, place, 0).reshape(shape)
    steady = seen & known & (sign == 0) & (planted != 1) & (planted != -1)
    gains = light_gains(one, other, steady if steady.any() else seen)
    relit = with_light(other, gains)
    kinds = colour_kinds(one, relit, steady)
    for where, kind in (
        (planted == -1, LOST),
        (planted == 1, GAINED),
        (sign < 0, LOWER),
        (sign > 0, HIGHER),
        (~seen | ~known, UNKNOWN),
    ):
        kinds[where] = kind
    return View(name, one, relit, kinds)
