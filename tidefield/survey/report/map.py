"""The survey location map, the paper's Figure 3, as numbers in the units of an SVG that `templates/map.svg` draws."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from tidefield.survey.report.findings import Findings
from tidefield.survey.report.graticule import Line, Sheet, affine, degree_ticks, grid_lines, round_step
from tidefield.survey.report.numbers import crs_title
from tidefield.survey.report.pictures import coverage_uri
from tidefield.survey.report.statistics import Statistics

WIDEST, HIGHEST = 760.0, 900.0  # of the map's frame
LEFT, RIGHT, TOP, BOTTOM = 26.0, 26.0, 24.0, 60.0  # margins, for coordinates and the scale bar
BORDER = 0.03  # of the extent, around what is drawn
NARROWEST = 0.45  # of the longer side: a single strip still has a map with room for its margins
ARROWS = 14
LONG_PAUSE = 5.0  # times the usual time between photographs: the flight's line is broken there

Places = dict[str, Float64[np.ndarray, " 2"]]  # World's x and y by name


@dataclass(frozen=True)
class Spot:
    """A labelled place."""

    x: float
    y: float
    label: str


@dataclass(frozen=True)
class Arrow(Spot):
    """A place and the direction there, in degrees clockwise from the map's right."""

    degrees: float


@dataclass(frozen=True)
class SurveyMap:
    """What the map's template draws; x to the right and y down, the frame at (`left`, `top`).

    Attributes:
        coverage: the picture of the coverage raster and its box.
        columns, rows: grid lines, labelled below and on the left.
        longitudes, latitudes: ticks above and on the right.
        flights: the lines of the flight, each a list of "x,y"; `ends` are the first and the last photograph.
        lost: where photographs that are not in the model were taken.
        bar: length of the scale bar and what it stands for.
    """

    width: float
    height: float
    left: float
    top: float
    inner_width: float
    inner_height: float
    coverage: str
    coverage_box: tuple[float, float, float, float]
    columns: list[Line]
    rows: list[Line]
    longitudes: list[Line]
    latitudes: list[Line]
    footprints: list[str]
    cameras: list[Spot]
    dot: float
    flights: list[str]
    ends: list[Spot]
    arrows: list[Arrow]
    lost: list[Spot]
    control: list[Spot]
    check: list[Spot]
    bar: tuple[float, str]
    grid_name: str
    located: bool


def draw_map(findings: Findings, statistics: Statistics) -> SurveyMap:
    """Lay the map out."""
    coverage, order, position = statistics.coverage, statistics.order, statistics.block.position[:, :2]
    lost = _lost(findings, Sheet(coverage.corner, coverage.far_corner, 1.0, 0.0, 0.0))
    sheet = _sheet(findings, statistics, lost)
    size = (sheet.high - sheet.low) * sheet.scale
    (west, south), (east, north) = sheet.at(np.stack([coverage.corner, coverage.far_corner])).tolist()
    places = sheet.at(position)
    cameras = [Spot(x, y, name) for (x, y), name in zip(places.tolist(), statistics.block.names, strict=True)]
    frame = findings.frame
    grid = affine(sheet, frame.to_crs) if frame else np.eye(2, 3)
    geographic = affine(sheet, frame.to_geographic) if frame else None
    control, check = _surveyed(findings, "control"), _surveyed(findings, "check")
    flights, arrows = _flights(statistics, places)
    return SurveyMap(
        width=LEFT + size[0] + RIGHT,
        height=TOP + size[1] + BOTTOM,
        left=LEFT,
        top=TOP,
        inner_width=size[0],
        inner_height=size[1],
        coverage=coverage_uri(coverage.count),
        coverage_box=(west, north, east - west, south - north),
        columns=grid_lines(sheet, grid, 0),
        rows=grid_lines(sheet, grid, 1),
        longitudes=degree_ticks(sheet, geographic, 0) if geographic is not None else [],
        latitudes=degree_ticks(sheet, geographic, 1) if geographic is not None else [],
        footprints=[_path(sheet.at(outline)) for outline in statistics.footprints if len(outline)],
        cameras=cameras,
        dot=float(np.clip(3.4 * math.sqrt(150 / len(places)), 1.1, 3.4)),
        flights=flights,
        ends=[replace(cameras[order[0]], label="first"), replace(cameras[order[-1]], label="last")],
        arrows=arrows,
        lost=_spots(sheet, lost),
        control=_spots(sheet, control),
        check=_spots(sheet, {name: place for name, place in check.items() if name not in control}),
        bar=_scale_bar(sheet, "m" if frame else "units"),
        grid_name=crs_title(frame) if frame else "the model's own unit",
        located=frame is not None,
    )


def _sheet(findings: Findings, statistics: Statistics, lost: Places) -> Sheet:
    coverage = statistics.coverage
    drawn = np.concatenate([coverage.corner[None], coverage.far_corner[None], statistics.block.position[:, :2]])
    low, high = drawn.min(0), drawn.max(0)
    surveyed = _surveyed(findings, "control") | _surveyed(findings, "check")
    points = np.array([*surveyed.values(), *lost.values()]).reshape(-1, 2)
    # What is far away is a mistake, and would make the survey a dot.
    points = points[((points > low - (high - low)) & (points < high + (high - low))).all(1)]
    drawn = np.concatenate([drawn, points])
    low, high = drawn.min(0), drawn.max(0)
    longest = max(float((high - low).max()), 1e-9)
    size = np.maximum(high - low, NARROWEST * longest) + 2 * BORDER * longest
    low, high = (low + high - size) / 2, (low + high + size) / 2
    return Sheet(low, high, float(min((WIDEST - LEFT - RIGHT) / size[0], HIGHEST / size[1])), LEFT, TOP)


def _path(xy: Float64[np.ndarray, "K 2"]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy.tolist())


def _flights(statistics: Statistics, places: Float64[np.ndarray, "N 2"]) -> tuple[list[str], list[Arrow]]:
    """Lines through the cameras in the order of the flight, broken at long pauses, and arrows along them."""
    order = statistics.order
    times = np.array([math.nan if p is None else p.time_s for p in statistics.photographs])[order]
    pause = np.diff(times)
    long = np.flatnonzero(pause > LONG_PAUSE * np.median(pause)) if np.isfinite(pause).all() and len(pause) else []
    parts = [places[part] for part in np.split(order, np.array(long, dtype=int) + 1)]
    legs = [leg for part in parts for leg in pairwise(part)]
    arrows = []
    for start, end in legs[:: max(1, math.ceil(len(legs) / ARROWS))]:
        (x, y), (along, down) = (start + end) / 2, end - start
        arrows.append(Arrow(float(x), float(y), "", math.degrees(math.atan2(down, along))))
    return [_path(part) for part in parts if len(part) > 1], arrows


def _surveyed(findings: Findings, kind: str) -> Places:
    places: Places = {}
    for residuals in findings.residuals:
        if residuals.kind == kind:
            places |= dict(zip(residuals.names, residuals.stated_world[:, :2], strict=True))
    return places


def _lost(findings: Findings, sheet: Sheet) -> Places:
    """Where photographs that are not in the model were taken, as far as known."""
    if findings.frame is None:
        return {}
    geographic = affine(sheet, findings.frame.to_geographic)
    lost = {left_out.name for left_out in findings.left_out}
    places: Places = {}
    for photograph in findings.survey.photographs:
        if photograph.name in lost and photograph.position is not None:
            there = (photograph.position.longitude_deg, photograph.position.latitude_deg)
            places[photograph.name] = np.linalg.solve(geographic[:, :2], there - geographic[:, 2])
    return places


def _spots(sheet: Sheet, places: Places) -> list[Spot]:
    """Those of the places that are on the map."""
    xy = np.array(list(places.values())).reshape(-1, 2)
    spots = zip(sheet.at(xy).tolist(), places, sheet.holds(xy), strict=True)
    return [Spot(x, y, name) for (x, y), name, shown in spots if shown]


def _scale_bar(sheet: Sheet, unit: str) -> tuple[float, str]:
    length = round_step(float(sheet.high[0] - sheet.low[0]) / 8)
    text = f"{length / 1000:g} km" if unit == "m" and length >= 1000 else f"{length:g} {unit}"
    return length * sheet.scale, text
