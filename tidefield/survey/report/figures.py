"""Draw the survey location map (the paper's Figure 3) and the charts of a report as SVG for its page."""

from __future__ import annotations

import io
import math
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float64, Real
from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import Affine2D

from tidefield.geometry.geodesy import LocalFrame, near_longitude, parse_crs
from tidefield.survey.report.findings import Comparison, Findings
from tidefield.survey.report.numbers import CLASSES, crs_title, degrees
from tidefield.survey.report.statistics import Statistics

# A separate hue for ground in a single photograph, then pale to dark: distinct for colour-blind readers too.
COLOURS = ("#f2d5c4", "#f7f0cd", "#cfe6c4", "#97cfbd", "#52a7b5", "#2c7199", "#1d3d68")
INK, SOFT, RULE, BAR, DOT = "#1c2328", "#55626b", "#d5dbdf", "#52a7b5", "#1f5f86"
LOST, CONTROL, CHECK = "#b3261e", "#d6246e", "#f0b400"

# Lengths below are units of the SVG, of which the page shows 1 to 1.25 pixels each.
WIDEST, HIGHEST = 700.0, 860.0  # of the map's frame
LEFT, RIGHT, TOP, BOTTOM = 42.0, 24.0, 24.0, 104.0  # margins: coordinates, scale bar and legend
LABEL_HALF = 34.0  # half the length of a coordinate: nearer to a corner it would meet that of the other side
BORDER = 0.03  # of the extent, around what is drawn
NARROWEST = 0.45  # of the longer side: a single strip still has a map with room for its margins
ARROWS = 14
LONG_PAUSE = 5.0  # times the usual time between photographs: the flight's line is broken there

XY = Float64[np.ndarray, " 2"]
"""x and y in the world."""
Affine = Float64[np.ndarray, "2 3"]
Tooltips = dict[str, list[str]]
"""By id of an artist (`set_gid`): a text for each of its markers, or one for the whole."""

# From matplotlib's defaults, whatever the user's matplotlibrc says.
STYLE: list[Any] = [
    "default",
    {
        "svg.fonttype": "none",
        "font.size": 10.5,
        "text.color": INK,
        "text.parse_math": False,  # names may hold dollar signs
        "axes.labelsize": 10.5,
        "axes.labelcolor": SOFT,
        "axes.linewidth": 0.9,
        "axes.axisbelow": True,
        "xtick.labelsize": 10,
        "ytick.labelsize": 10,
        "legend.fontsize": 10.5,
        "lines.linewidth": 0.9,
    },
]


def spaced(value: float | int, digits: int = 0) -> str:
    """Format a number with narrow spaces between its thousands and a true minus."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "\u2212")


@style.context(STYLE)
def draw_map(findings: Findings, statistics: Statistics) -> Markup:
    """Draw coverage, footprints, flight, cameras and surveyed points, north up, in the products' coordinates."""
    coverage, position = statistics.coverage, statistics.block.position[:, :2]
    corners = np.stack([coverage.corner, coverage.far_corner])
    lost = _lost_cameras(findings, corners)
    surveyed = {name: place[:2] for name, place in findings.control_points().items()}
    low, high = _extent(np.concatenate([corners, position]), [*lost.values(), *surveyed.values()])
    size = (high - low) * min(WIDEST / (high - low)[0], HIGHEST / (high - low)[1])
    width, height = LEFT + size[0] + RIGHT, TOP + size[1] + BOTTOM
    figure = _figure(width, height)
    axes = figure.add_axes((LEFT / width, BOTTOM / height, size[0] / width, size[1] / height))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor="#fafbfb")
    _draw_coverage(axes, statistics)
    _draw_grid(axes, findings.frame, low, high)
    tooltips = _draw_survey(axes, findings, statistics, lost, surveyed)
    margin = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height), facecolor="none")
    margin.set_axis_off()
    _draw_scale_bar(margin, float(high[0] - low[0]), size[0], "m" if findings.frame else "units")
    if findings.frame:
        _draw_north(margin, width - RIGHT - 26, height - TOP - 36)
    axes.legend(
        bbox_to_anchor=(LEFT / width, 44 / height),
        bbox_transform=figure.transFigure,
        loc="upper left",
        ncols=3 if size[0] > 560 else 2,
        frameon=False,
        borderaxespad=0.2,
        borderpad=0.2,
    )
    description = (
        f"Survey location map: {len(position)} cameras, the line of the flight and the footprints of the photographs, "
        "over the number of photographs that see each piece of ground."
    )
    return _embedded(figure, "map", "map", description, tooltips)


@style.context(STYLE)
def draw_histogram(
    title: str, axis: str, counted: str, values: Real[np.ndarray, " K"], digits: int | None
) -> Markup | None:
    """Draw the histogram of the finite values; None if there are fewer than two.

    Args:
        title: heading for screen readers.
        axis: what is measured, with its unit.
        counted: what a bar counts.
        values: what is measured.
        digits: decimals in tooltips; None for whole numbers from 2, with a bar each.
    """
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return None
    if digits is None:
        edges = np.arange(2, max(int(known.max()), 3) + 2) - 0.5
        labels = [f"{value:g}" for value in edges[:-1] + 0.5]
    else:
        low, high = np.percentile(known, [0.5, 99.5])
        low, high = (low, high) if high - low > 1e-9 else (low - 0.5 * 10**-digits, low + 0.5 * 10**-digits)
        edges = np.linspace(low, high, min(24, max(6, round(math.sqrt(len(known))))) + 1)
        labels = [f"{start:.{digits}f} to {end:.{digits}f}" for start, end in pairwise(edges)]
    counts = np.histogram(np.clip(known, edges[0], edges[-1]), edges)[0].tolist()
    figure = _figure(340.0, 200.0)
    axes = figure.add_axes((0.155, 0.22, 0.825, 0.74))
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=BAR, edgecolor="white", linewidth=0.8)
    steps = [1, 2, 5, 10]
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=steps, integer=digits is None))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=steps, integer=True))
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}".replace(",", "\u202f")))
    axes.tick_params(length=0, labelcolor=SOFT)
    axes.grid(axis="y", color=RULE)
    axes.set(xlim=(edges[0], edges[-1]), xlabel=axis, ylabel=counted)
    axes.spines[["left", "top", "right"]].set_visible(False)
    tooltips: Tooltips = {}
    for bar, count, label in zip(axes.patches, counts, labels, strict=True):
        bar.set_gid(f"bar {len(tooltips)}")
        tooltips[f"bar {len(tooltips)}"] = [f"{label}: {spaced(count)}"]
    most = int(np.argmax(counts))
    where = f"{'at' if digits is None else 'from'} {labels[most]}"
    description = f"{title}. {spaced(sum(counts))} {counted}; most, {spaced(counts[most])}, {where}."
    return _embedded(figure, "chart", title, description, tooltips)


@style.context(STYLE)
def draw_residuals(comparison: Comparison) -> Markup | None:
    """Draw residuals in plan, and their heights in a strip next to it, which is empty where positions had none; None if
    no residuals are known."""
    finite = comparison.residuals.known_in_plan
    if not (finite & comparison.used).any():
        return None
    error_m, used = comparison.residuals.error_m[finite], comparison.used[finite]
    names = np.array(comparison.residuals.names, dtype=object)[finite]
    largest = max(float(np.nanmax(np.abs(error_m[used]))), 1e-6)
    step = _round_step(largest / 3)
    reach = step * math.ceil(largest / step - 1e-9)
    inside = error_m.clip(-1.03 * reach, 1.03 * reach)  # one that was not used may lie far outside
    figure = _figure(320.0, 246.0)
    plan, strip = figure.add_axes((0.17, 0.18, 0.60, 0.78)), figure.add_axes((0.79, 0.18, 0.06, 0.78))
    limits, ticks = (-1.08 * reach, 1.08 * reach), (-reach, 0, reach)
    labels = [f"{value:g}".replace("-", "\u2212") for value in ticks]
    for axes in (plan, strip):
        axes.axhline(0, color=RULE)
        axes.set(xlim=limits, ylim=limits)
        axes.set_xticks(ticks, labels)
        axes.set_yticks(ticks, labels)
        axes.tick_params(length=0, labelcolor=SOFT)
        axes.spines[:].set_color(RULE)
    plan.axvline(0, color=RULE)
    for i in range(1, round(reach / step) + 1):
        plan.add_patch(Circle((0, 0), i * step, fill=False, color=RULE, linewidth=0.9))
        strip.axhspan(-i * step, i * step, fill=False, color=RULE)
    plan.set(xlabel=f"East (m); a ring every {step:g} m", ylabel="North (m)")
    plan.yaxis.labelpad = -6
    strip.yaxis.set_label_position("right")
    strip.yaxis.tick_right()
    strip.set(xticks=[], xlim=(-1, 1), ylabel="Up (m)")
    for keep, gid, marker in (
        (used, "used", {"marker": "o", "color": DOT, "alpha": 0.7, "markersize": 4.6, "markeredgewidth": 0}),
        (~used, "unused", {"marker": "x", "color": LOST, "markersize": 5.5, "markeredgewidth": 1.4}),
    ):
        plan.plot(inside[keep, 0], inside[keep, 1], linestyle="", gid=gid, **marker)
        if np.isfinite(error_m[:, 2]).all():
            strip.plot(np.zeros(keep.sum()), inside[keep, 2], linestyle="", gid=gid, **marker)
    longest = float(np.hypot(*error_m[used, :2].T).max())
    description = f"{comparison.title}. Residuals in plan, the largest {longest:.3f} m long, and their heights."
    tooltips = {"used": [*names[used]], "unused": [f"{name}: not used" for name in names[~used]]}
    return _embedded(figure, "chart", comparison.title, description, tooltips)


def _figure(width: float, height: float) -> Figure:
    """Make a figure of a size in units of the SVG."""
    return Figure(figsize=(width / 72, height / 72), facecolor="none")


def _embedded(figure: Figure, kind: str, name: str, description: str, tooltips: Tooltips) -> Markup:
    """Render a figure to an SVG element that shares a page with others; its text stays text.

    Args:
        kind: class of the element.
        name: what the ids in it are made from; unique in the page.
        description: for screen readers.
        tooltips: of the markers.
    """
    matplotlib.rcParams["svg.hashsalt"] = name
    buffer = io.StringIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)  # the browser has other fonts
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    root = ET.fromstring(buffer.getvalue())
    for element in list(root.iter()):  # no metadata and styles, no namespaces, no spaces between elements
        for child in [child for child in element if child.tag.endswith(("}metadata", "}style"))]:
            element.remove(child)
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
        element.tail = element.text = None if element.tag != "text" else element.text
        for key in {"d", "x", "y"} & element.attrib.keys():  # a hundredth of a pixel is enough
            element.set(key, re.sub(r"(\.\d\d)\d+", r"\1", element.attrib[key]).replace("\n", ""))
    for group in list(root.iter("g")):
        gid = group.attrib.pop("id", "")
        if gid == "label":
            group.set("class", gid)
        if tooltips.get(gid):
            for marker, text in zip([*group.iter("use")] or [group], tooltips[gid], strict=True):
                title = ET.Element("title")
                title.text = text
                marker.insert(0, title)
    root.attrib = {"class": kind, "viewBox": root.attrib["viewBox"], "role": "img", "aria-label": description}
    return Markup(ET.tostring(root, encoding="unicode"))  # ElementTree has escaped every name


def _extent(drawn: Float64[np.ndarray, "K 2"], others: list[XY]) -> tuple[XY, XY]:
    """Return the map's corners: what must be drawn, and of the others those that are not far away."""
    low, high = drawn.min(0), drawn.max(0)
    points = np.array(others, dtype=np.float64).reshape(-1, 2)
    # What is far away is a mistake, and would make the survey a dot.
    points = points[((points > low - (high - low)) & (points < high + (high - low))).all(1)]
    drawn = np.concatenate([drawn, points])
    low, high = drawn.min(0), drawn.max(0)
    longest = max(float((high - low).max()), 1e-9)
    size = np.maximum(high - low, NARROWEST * longest) + 2 * BORDER * longest
    return (low + high - size) / 2, (low + high + size) / 2


def _draw_coverage(axes: Axes, statistics: Statistics) -> None:
    coverage = statistics.coverage
    (west, south), (east, north) = coverage.corner, coverage.far_corner
    axes.imshow(
        np.ma.masked_equal(coverage.count, 0),
        ListedColormap(COLOURS),
        BoundaryNorm([*(least for least, _ in CLASSES), np.iinfo(np.uint16).max], len(COLOURS)),
        origin="lower",
        extent=(west, east, south, north),
        aspect="auto",
        interpolation="none",
    )
    rings = [np.array([*outline.exterior.coords, (np.nan, np.nan)]) for outline in statistics.footprints if outline]
    if rings:
        line = {"color": INK, "alpha": 0.32, "linewidth": 0.5, "zorder": 1}
        axes.plot(*np.concatenate(rings).T, **line, label="footprint of a photograph")


def _draw_survey(
    axes: Axes, findings: Findings, statistics: Statistics, lost: dict[str, XY], surveyed: dict[str, XY]
) -> Tooltips:
    """Draw flight, cameras, photographs that are not in the model and surveyed points."""
    order, position = statistics.order, statistics.block.position[:, :2]
    tooltips: Tooltips = {}
    _draw_flight(axes, statistics)
    dot = float(np.clip(6.8 * math.sqrt(150 / len(position)), 2.2, 6.8))
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()

    def markers(gid: str, points: dict[str, XY], label: str, suffix: str = "", **marker) -> dict[str, XY]:
        """Draw those points that lie in the frame, and return them."""
        shown = {name: (x, y) for name, (x, y) in points.items() if west <= x <= east and south <= y <= north}
        if shown:
            axes.plot(*np.array([*shown.values()]).T, linestyle="", gid=gid, label=label, **marker)
            tooltips[gid] = [name + suffix for name in shown]
        return {name: points[name] for name in shown}

    markers("lost", lost, "photograph not in the model, by its GPS", ": not in the model", marker="x", color=LOST)
    white: dict[str, Any] = {"markerfacecolor": "white", "markeredgecolor": INK}
    cameras = dict(zip(statistics.block.names, position, strict=True))
    markers("cameras", cameras, "camera", marker="o", markersize=dot, markeredgewidth=1.0, **white)
    for i, name in ((order[0], "first"), (order[-1], "last")):
        axes.plot(*position[i], "o", markersize=dot + 5, markerfacecolor="none", markeredgecolor=INK)
        _annotate(axes, name, position[i], above=True)
    fitted = {name for c in findings.comparisons() if c.kind == "control" for name in c.residuals.names}
    triangle: dict[str, Any] = {"marker": "^", "markersize": 9, "color": CONTROL, "markeredgecolor": "white"}
    diamond: dict[str, Any] = {"marker": "D", "markersize": 7, "color": CHECK, "markeredgecolor": INK}
    for kind, is_fitted, marker in (("control", True, triangle), ("check", False, diamond)):
        points = {name: place for name, place in surveyed.items() if (name in fitted) == is_fitted}
        for name, place in markers(kind, points, f"{kind} point", **marker).items():
            _annotate(axes, name, place)
    return tooltips


def _annotate(axes: Axes, text: str, place: XY, above: bool = False) -> None:
    """Write a label to the right of a point, or above it; the page's style sheet gives it its halo."""
    printable = "".join(c if c.isprintable() else "\ufffd" for c in text)  # XML has no control characters
    font: dict[str, Any] = {"ha": "center", "va": "bottom"} if above else {"va": "center"}
    font |= {"fontsize": 10, "fontweight": "bold", "gid": "label", "clip_on": True, "zorder": 1.9}
    axes.annotate(printable, tuple(place), (0, 6) if above else (8, 0), textcoords="offset points", **font)


def _draw_flight(axes: Axes, statistics: Statistics) -> None:
    """Draw lines through the cameras in the order of each flight, broken at long pauses, and arrows along them."""
    position = statistics.block.position[:, :2]
    times = np.array([photograph.time_s for photograph in statistics.photographs])
    timed = bool(np.isfinite(times).all())
    label = f"flight, in order of {'time' if timed else 'name'}"
    parts: list[Float64[np.ndarray, "K 2"]] = []
    for order in statistics.flights:
        pause = np.diff(times[order])
        breaks = np.flatnonzero(pause > LONG_PAUSE * np.median(pause)) + 1 if timed and len(pause) else []
        parts += [position[part] for part in np.split(order, breaks)]
    for part in parts:
        axes.plot(*part.T, color="white", alpha=0.75, linewidth=3, zorder=1.8)
        axes.plot(*part.T, color=INK, linewidth=1.1, zorder=1.8, label=label if part is parts[0] else "_")
    legs = [leg for part in parts for leg in pairwise(part)]
    for start, end in legs[:: max(1, math.ceil(len(legs) / ARROWS))]:
        turn = Affine2D().rotate(math.atan2(end[1] - start[1], end[0] - start[0]))
        arrow = MarkerStyle([(1, 0), (-0.8, 0.75), (-0.4, 0), (-0.8, -0.75), (1, 0)], transform=turn)
        axes.plot(*(start + end) / 2, marker=arrow, markersize=9, color=INK, markeredgecolor="white", zorder=1.8)


def _draw_grid(axes: Axes, frame: LocalFrame | None, low: XY, high: XY) -> None:
    """Draw lines of equal easting and northing, and ticks of longitude (above) and latitude (on the right).

    Over so little of the Earth, both are affine in x and y to less than a line's width.
    """
    grid = affine(low, high, frame.to_crs) if frame else np.eye(2, 3)
    across = [0, 1] if abs(grid[0, 0]) >= abs(grid[0, 1]) else [1, 0]  # the axis that counts from west to east, or back
    grid = grid[across]
    geographic = _geographic(frame, low, high) if frame else None
    label_half = LABEL_HALF * float(high[0] - low[0]) / axes.bbox.width

    def label(where: Axis, axis: int, places: Float64[np.ndarray, " K"], labels: list[str]) -> None:
        """Set ticks inside the frame; those near a corner have no label."""
        gap = np.minimum(places - low[axis], high[axis] - places)
        texts = [text if room > label_half else "" for text, room in zip(labels, gap, strict=True) if room >= 0]
        where.set_ticks(places[gap >= 0], labels=texts, **({"rotation": 90, "va": "center"} if axis else {}))

    for axis, where in enumerate((axes.xaxis, axes.yaxis)):
        values, digits = coordinates(grid, low, high, axis, 6)
        near, far = (crossings(grid, axis, values, float(edge[1 - axis])) for edge in (low, high))
        for start, end in zip(near, far, strict=True):
            line = [(start, end), (low[1 - axis], high[1 - axis])]
            axes.plot(*(line if axis == 0 else line[::-1]), color=INK, alpha=0.28, linewidth=0.6, zorder=1)
        where.set_tick_params(length=4, color=INK, pad=2, labelcolor=INK)
        label(where, axis, near, [spaced(value, digits) for value in values])
        if geographic is None:
            continue
        values, digits = coordinates(geographic, low, high, axis, 4)
        texts = [
            f"{abs(value):.{digits}f}° {('EW', 'NS')[axis][bool(value < 0)]}" for value in near_longitude(values, 0.0)
        ]
        other = axes.secondary_yaxis("right").yaxis if axis else axes.secondary_xaxis("top").xaxis
        other.set_tick_params(length=4, color=INK, pad=2, labelcolor=INK)
        label(other, axis, crossings(geographic, axis, values, float(high[1 - axis])), texts)
    if frame is None:
        axes.set(xlabel="x (model units)", ylabel="y (model units)")
    else:
        counted = parse_crs(frame.crs).axis_info[:2]
        unit = counted[0].unit_name.replace("metre", "m")
        names = ["Easting", "Northing"]
        if {axis.direction for axis in counted} == {"west", "south"}:
            names = [counted[k].name for k in across]
        axes.set(xlabel=f"{names[0]} ({unit}), {crs_title(frame)}", ylabel=f"{names[1]} ({unit})")


def _geographic(frame: LocalFrame, low: XY, high: XY) -> Affine:
    """Fit the matrix to longitude and latitude, in which longitude continues across the date line."""
    return affine(low, high, lambda xyz: degrees(frame, xyz[:, :2]))


def affine(low: XY, high: XY, transform: Callable[[np.ndarray], np.ndarray]) -> Affine:
    """Fit the matrix that takes (x, y, 1) between two corners of the world to `transform`'s first two coordinates."""
    x, y = np.meshgrid(*np.linspace(low, high, 3).T)
    design = np.stack([x.ravel(), y.ravel(), np.ones(9)], 1)
    there = transform(np.c_[design[:, :2], np.zeros(9)])[:, :2]
    return np.linalg.lstsq(design, there, rcond=None)[0].T


def coordinates(matrix: Affine, low: XY, high: XY, axis: int, number: int) -> tuple[Float64[np.ndarray, " K"], int]:
    """Choose about `number` round values of a coordinate between two corners of the world, and their decimals."""
    corners = np.array([(x, y, 1) for x in (low[0], high[0]) for y in (low[1], high[1])]) @ matrix[axis]
    step = _round_step(float(np.ptp(corners)) / (number + 0.5))
    values = np.arange(math.ceil(corners.min() / step), math.floor(corners.max() / step) + 1) * step
    return values, max(0, -math.floor(math.log10(step) + 1e-9))


def crossings(matrix: Affine, axis: int, values: Float64[np.ndarray, " K"], edge: float) -> Float64[np.ndarray, " K"]:
    """Where on a horizontal (axis 0, x) or vertical (axis 1, y) edge of the map a coordinate takes the values."""
    return (values - matrix[axis, 2] - matrix[axis, 1 - axis] * edge) / matrix[axis, axis]


def _round_step(least: float) -> float:
    """1, 2 or 5 times a power of ten, not less than `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * (1 - 1e-9))


def _lost_cameras(findings: Findings, corners: Float64[np.ndarray, "2 2"]) -> dict[str, XY]:
    """Where photographs that are not in the model were taken, as far as known."""
    if findings.frame is None:
        return {}
    frame = findings.frame
    geographic = _geographic(frame, corners[0], corners[1])
    lost = {photograph.name for photograph in findings.left_out}
    return {
        p.name: np.linalg.solve(
            geographic[:, :2],
            (near_longitude(p.position.longitude_deg, frame.longitude_deg), p.position.latitude_deg) - geographic[:, 2],
        )
        for p in findings.survey.photographs
        if p.name in lost and p.position is not None
    }


def _draw_scale_bar(margin: Axes, extent: float, width: float, unit: str) -> None:
    """Draw a bar of four parts below the map, as long as a fifth to two fifths of it."""
    length = _round_step(extent / 5)
    part, y = length / extent * width / 4, 52.0
    starts, colours = LEFT + part * np.arange(4), [INK, "white"] * 2
    margin.barh(np.full(4, y), part, 5, starts, color=colours, edgecolor=INK, linewidth=0.9)
    kilometres = unit == "m" and length >= 1000
    for share in (0, 0.5, 1):
        value = f"{share * length / (1000 if kilometres else 1):g}"
        text = f"{value} {'km' if kilometres else unit}" if share == 1 else value
        margin.text(LEFT + 4 * part * share, y + 5, text, ha="center", va="bottom", fontsize=10)


def _draw_north(margin: Axes, x: float, y: float) -> None:
    margin.plot(x, y, "o", markersize=50, color="white", alpha=0.85, markeredgewidth=0, zorder=0)
    for side, colour in ((-1, INK), (1, "white")):
        xs, ys = x + np.array([0, side * 6.5, 0]), y + np.array([13, -13, -8])
        margin.fill(xs, ys, facecolor=colour, edgecolor=INK, lw=1)
    margin.text(x, y + 15, "N", ha="center", va="bottom", fontsize=11, fontweight="bold", gid="label")
