"""Measure a reconstruction: resolution, heights, coverage, overlap and errors, per photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int, UInt16
from shapely import Polygon
from shapely.geometry.polygon import orient

from tidefield.survey.io.photographs import by_camera
from tidefield.survey.report.block import Block, read_block
from tidefield.survey.report.findings import Findings
from tidefield.survey.report.ground import fit_ground, footprints
from tidefield.survey.survey import Photograph

LONG_SIDE = 600  # cells
SAME_PLACE = 0.02  # of the height: photographs nearer than this were taken from one place
PARALLEL_DEG = 30.0

Flights = tuple[Int[np.ndarray, " K"], ...]
"""Indices of photographs in the order of a flight, for each of the flights."""


@dataclass(frozen=True)
class Coverage:
    """A raster over the survey.

    Attributes:
        count: photographs whose footprint holds the cell's centre; rows from south to north.
        corner: x and y of the raster's south-western corner.
        cell: side of a cell.
    """

    count: UInt16[np.ndarray, "h w"]
    corner: Float64[np.ndarray, " 2"]
    cell: float

    @property
    def far_corner(self) -> Float64[np.ndarray, " 2"]:
        """x and y of the north-eastern corner."""
        return self.corner + np.array(self.count.shape[::-1]) * self.cell

    def area(self, least: int, most: int | None = None) -> float:
        """Area that at least `least` and at most `most` photographs see."""
        seen = self.count >= least
        return float((seen if most is None else seen & (self.count <= most)).sum()) * self.cell**2


@dataclass(frozen=True)
class Statistics:
    """Measures of a model; lengths in metres where it has a georeference, else in its own unit; NaN where unknown.

    Attributes:
        block: the model as arrays.
        photographs: what was read of each registered photograph.
        flights: registered photographs in the order of each flight: by time, or by name where times are missing.
        gsd: ground sampling distance of every photograph: median over its points of z-depth / focal length.
        height: of every camera above the ground beneath.
        footprints: what each covers of the ground, counter-clockwise x and y; empty if it sees none.
        coverage: how many photographs see each piece of ground.
        forward_overlap: share of each footprint that the nearest photograph ahead or behind along the flight sees too,
            the larger of the two; NaN where there is none.
        side_overlap: the same of the nearest to the side, on a parallel line.
        error_px: reprojection error of every observation.
        mean_px, rms_px: per photograph.
        held_out: whether each photograph was placed afterwards.
        observed: points that every photograph observes; held-out ones have none.
        track_length: photographs that observe each point.
    """

    block: Block
    photographs: tuple[Photograph, ...]
    flights: Flights
    gsd: Float64[np.ndarray, " N"]
    height: Float64[np.ndarray, " N"]
    footprints: tuple[Polygon, ...]
    coverage: Coverage
    forward_overlap: Float64[np.ndarray, " N"]
    side_overlap: Float64[np.ndarray, " N"]
    error_px: Float64[np.ndarray, " O"]
    mean_px: Float64[np.ndarray, " N"]
    rms_px: Float64[np.ndarray, " N"]
    held_out: Bool[np.ndarray, " N"]
    observed: Int[np.ndarray, " N"]
    track_length: Int[np.ndarray, " P"]

    @property
    def order(self) -> Int[np.ndarray, " N"]:
        """The photographs of one flight after the other."""
        return np.concatenate(self.flights)


def measure(findings: Findings) -> Statistics:
    """Compute all statistics of the reconstruction.

    Raises:
        SurveyError: nothing is registered, or there are no points.
    """
    block = read_block(findings.reconstruction, level=findings.frame is None)
    known = {photograph.name: photograph for photograph in findings.survey.photographs}
    photographs = tuple(known[name] for name in block.names)
    flights = find_flights(photographs)
    track_length = np.bincount(block.point, minlength=len(block.points))
    trusted = block.points[track_length > 2]
    ground = fit_ground(trusted if len(trusted) >= len(block.points) / 4 else block.points)
    height = ground.above(block.position)
    outlines = footprints(block, ground)
    forward, side = overlap(outlines, block.position, flights, float(np.median(height)))
    gsd, error_px, mean_px, rms_px = _resolution_and_errors(block)
    return Statistics(
        block=block,
        photographs=photographs,
        flights=flights,
        gsd=gsd,
        height=height,
        footprints=outlines,
        coverage=cover(outlines),
        forward_overlap=forward,
        side_overlap=side,
        error_px=error_px,
        mean_px=mean_px,
        rms_px=rms_px,
        held_out=np.array([name in findings.held_out for name in block.names]),
        observed=np.bincount(block.photograph, minlength=len(block)),
        track_length=track_length,
    )


def find_flights(photographs: Sequence[Photograph]) -> Flights:
    """Sort photographs by time, or by name where times are missing; what two drones, or two cameras of a rig, took at
    once are two flights.

    A folder continues the flight that ended last before it, one of its own camera first.
    """
    groups = by_camera(photographs)
    times = [photograph.time_s for photograph in photographs]
    if not np.isfinite(times).all():
        return (np.concatenate(groups).astype(np.int64),)
    cameras = [(photograph.camera, photograph.serial) for photograph in photographs]
    found: list[list[int]] = []
    for own in sorted((sorted(own, key=times.__getitem__) for own in groups), key=lambda own: times[own[0]]):
        ended = [flight for flight in found if times[flight[-1]] <= times[own[0]]]
        if ended:
            max(ended, key=lambda one: (cameras[one[-1]] == cameras[own[0]], times[one[-1]])).extend(own)
        else:
            found.append(own)
    return tuple(np.array(own, dtype=np.int64) for own in found)


def _resolution_and_errors(block: Block) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per photograph: ground sampling distance; per observation: error; per photograph: its mean and RMS."""
    gsd, mean, rms = np.full((3, len(block)), np.nan)
    error = np.zeros(len(block.point))
    for i, mine in block.observations():
        camera = block.camera(i)
        offset = block.points[block.point[mine]] - block.position[i]
        in_camera = offset @ block.R_world_camera[i]
        gsd[i] = np.median(in_camera[:, 2]) / camera.mean_focal_length()
        error[mine] = np.linalg.norm(camera.img_from_cam(in_camera) - block.uv_px[mine], axis=1)
        here = error[mine][np.isfinite(error[mine])]  # a point behind the camera has no image
        if len(here):
            mean[i], rms[i] = np.mean(here), np.sqrt(np.mean(here**2))
    return gsd, error, mean, rms


def cover(footprints: tuple[Polygon, ...]) -> Coverage:
    """Count the footprints over every cell of a raster that holds them all."""
    bounds = shapely.total_bounds(footprints).reshape(2, 2)
    low, high = bounds if np.isfinite(bounds).all() else np.array([[0.0, 0.0], [1.0, 1.0]])  # nothing is seen
    cell = float((high - low).max()) / LONG_SIDE
    columns, rows = np.ceil((high - low) / cell - 1e-9).astype(int).clip(1)
    # A hair beyond the centres, so that one on the common border of two footprints counts in one of them.
    x, y = (low[0] + (np.arange(columns) + 0.5 + 1e-6) * cell, low[1] + (np.arange(rows) + 0.5 + 1e-6) * cell)
    count = np.zeros((rows, columns), np.uint16)
    # cv2.fillPoly also fills cells that the border only touches: a footprint of 120 by 90 cells would grow by 1 to 2%.
    for outline in footprints:
        west, south, east, north = outline.bounds
        window = slice(*np.searchsorted(y, (south, north))), slice(*np.searchsorted(x, (west, east)))
        count[window] += shapely.contains_xy(outline, *np.meshgrid(x[window[1]], y[window[0]]))
    return Coverage(count, low, cell)


def unite(footprints: tuple[Polygon, ...]) -> shapely.MultiPolygon:
    """Outline the area that any photograph sees; outer rings run counter-clockwise."""
    # An outline that crosses itself cannot be united; made valid, it may hold lines, too.
    parts = shapely.get_parts(shapely.make_valid(np.array(footprints, dtype=object)))
    return shapely.MultiPolygon(
        [orient(part) for part in shapely.get_parts(shapely.union_all(parts[shapely.area(parts) > 0]))]
    )


def overlap(
    footprints: tuple[Polygon, ...], position: Float64[np.ndarray, "N 3"], flights: Flights, height: float
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Measure forward and side overlap from geometry alone, so that a missing photograph shows as a gap.

    Args:
        footprints: of every photograph; their convex hulls are compared.
        position: of the cameras.
        flights: photographs in the order of each flight, from which its heading follows.
        height: of the flight above ground.

    Returns:
        `Statistics.forward_overlap` and `side_overlap`.
    """
    hulls = shapely.convex_hull(np.array(footprints, dtype=object))
    heading = headings(position[:, :2], flights)
    forward, side = np.full((2, len(position)), np.nan)

    def shared(i: int, distance: Float64[np.ndarray, " N"], among: Bool[np.ndarray, " N"]) -> float:
        """Share of footprint `i` that the nearest of some photographs sees; NaN if there are none."""
        if not among.any():
            return np.nan
        nearest = hulls[np.where(among, distance, np.inf).argmin()]
        return min(hulls[i].intersection(nearest).area / hulls[i].area, 1.0)

    for i in np.flatnonzero(~shapely.is_empty(hulls)).tolist():
        offset = position[:, :2] - position[i, :2]
        along, across = offset @ heading[i], offset @ [-heading[i, 1], heading[i, 0]]
        distance = np.hypot(along, across)
        parallel = np.abs(heading @ heading[i]) > np.cos(np.radians(PARALLEL_DEG))
        candidate = parallel & (distance > SAME_PLACE * height)
        ahead = candidate & (np.abs(along) > np.abs(across))
        front, back = (shared(i, distance, ahead & (sign * along > 0)) for sign in (1, -1))
        forward[i] = np.fmax(front, back)
        side[i] = shared(i, distance, candidate & ~ahead)
    return forward, side


def headings(xy: Float64[np.ndarray, "N 2"], flights: Flights) -> Float64[np.ndarray, "N 2"]:
    """Unit vectors of the flight's heading: along the shorter leg, before or after the photograph; zero if it hovers or
    is the only one of its flight."""
    heading = np.zeros_like(xy)
    for order in (order for order in flights if len(order) > 1):
        steps = np.diff(xy[order], axis=0)
        length = np.linalg.norm(steps, axis=1)
        arriving, leaving = np.r_[np.inf, length], np.r_[length, np.inf]
        index = np.arange(len(order))
        chosen = steps[np.where(arriving < leaving, index - 1, np.minimum(index, len(steps) - 1))]
        heading[order] = chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)
    return heading
