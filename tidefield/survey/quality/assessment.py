"""Assess which photographs would degrade a scene, from their measures and those of their neighbours.

Every limit is a constant here and is stated in the reason, with the measure. No file is deleted; `select_photographs`
leaves photographs out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tidefield.errors import SurveyError
from tidefield.machine import cores
from tidefield.survey.io.image_decoding import thumbnail, used_pixels
from tidefield.survey.io.photographs import FEWEST
from tidefield.survey.io.positions import positions_m
from tidefield.survey.quality.measures import SIDE_PX, Measures, measure
from tidefield.survey.survey import Photograph, Progress, Survey

NEIGHBOURS = 6
"""Number of photographs, the nearest in position or else in time, with which one is compared."""

FLAT_CONTRAST = 10.0
# At 1% of the light, lit ground has a contrast of 12 to 18, and no matches; wet mud at dusk, which is as dark as lit
# ground at 8%, matches from 20 on.
DARK_HIGHLIGHTS, DARK_CONTRAST = 60.0, 20.0
DIM_HIGHLIGHTS, DIM_LIGHT = 80.0, 0.15  # of the light of the neighbours
WHITE = 0.2
GLARING_CLIPPED, GLARING_LIGHT = 0.2, 3.5  # times the light of the neighbours
# A blur of six pixels reduces sharpness to 0.05 to 0.11, both of a soft lens (0.2) and of a crisp one (0.5); a blur of
# three pixels, which does not harm a scene, to 0.12 and more.
SOFT, SOFT_OF_NEIGHBOURS, SOFT_OF_SURVEY = 0.11, 0.65, 0.7
SOFTER_OF_NEIGHBOURS, SOFTER_OF_SURVEY = 0.4, 0.35
HOPELESSLY_SOFT = 0.035
SKY, SKY_BELOW_HORIZON, SKY_AT_LEAST = 0.35, 0.3, 0.1
SKIES = 2
"""Of the neighbours: where so many have a sky, too, it is smooth water or mud, or the survey is oblique."""

GAP_SPACINGS = 6.0
"""A distance is a gap in the survey from this multiple of the median distance between neighbours ..."""
GAP_HEIGHTS = 3.0
"""... or of the flight height, where it is known: about two footprints."""
FEW, MAX_FEW = 0.05, 10
"""A larger share or number of photographs beyond a gap is a part of the survey."""
FEW_IN_ALL = 0.1
"""Where a larger share is beyond gaps, the survey has gaps."""
LOW = 0.35
"""Of the median height above take-off; lower photographs show the take-off or the landing."""
FEW_LOW = 0.1
"""A larger share of low photographs is a part of the survey."""

_MIN_GAP_M = 20.0  # positions of a hovering drone scatter
_GAP_OF_UNKNOWN_HEIGHT_M = 100.0  # neighbours may be of one flight line, or of cameras that fly together
_CELLS_IN_GAP = 8.0
_MAY_BE_DEEP = (".png", ".tif", ".tiff")  # 12 bits of a sensor, or temperatures, in 16
_UNKNOWN_FOCAL = 0.75  # of the longer side

MAX_SHIFT = 0.03
"""Largest shift of a duplicate, in longer sides: too short a baseline to measure heights."""
MIN_AGREEMENT = 0.6
"""Different views agree by at most 0.3, those of a hovering drone by 0.6 and more, even rotated by three degrees."""

# Accuracy of receivers, or this part of the flight height where it is larger.
_NEAR_M, _NEAR_OF_HEIGHT = 3.0, 0.05
_FAR_M = 20.0  # larger than the error of a receiver with a fix
_IN_SEQUENCE = 3
_COARSE = 16, 12
_MIN_CORRELATION = 0.5  # of the coarse outlines of two photographs, to compare them in full
_BLOCK = 20


@dataclass(frozen=True)
class QualityDecision:
    """The decision on one photograph.

    Attributes:
        name: of the photograph.
        measures: None if it cannot be decoded; then it is always left out.
        left_out: the reason to leave it out, in a sentence with the measure and its limit; None to keep it.
    """

    name: str
    measures: Measures | None
    left_out: str | None


def assess_quality(survey: Survey, progress: Progress | None = None) -> tuple[QualityDecision, ...]:
    """Decide on all photographs, in their order.

    Decodes one reduced image per processor at a time; about 20 kB of each are kept until the end.

    Raises:
        SceneError: a mask is damaged.
    """
    photographs = survey.photographs
    measured, outlines, reasons = _measure(photographs, progress)
    near = _neighbours(photographs)
    for index, measures in enumerate(measured):
        if measures is not None:
            neighbours = [other for other in (measured[i] for i in near[index]) if other is not None]
            reasons[index] = _flat_or_badly_exposed(measures, neighbours)
    # Photographs that are left out already must not be what the others are compared with.
    sharp = [math.nan if reason or not m else m.sharpness for m, reason in zip(measured, reasons, strict=True)]
    kinds = [(p.camera, min(p.width, p.height), max(p.width, p.height)) for p in photographs]
    of_kind = {k: _median([s for kind, s in zip(kinds, sharp, strict=True) if kind == k]) for k in set(kinds)}
    for index, measures in enumerate(measured):
        if measures is not None and reasons[index] is None:
            of_neighbours = _median([sharp[i] for i in near[index]])
            skies = sum(other.sky > SKY for other in (measured[i] for i in near[index]) if other is not None)
            reasons[index] = _blurred(sharp[index], of_kind[kinds[index]], of_neighbours) or _horizon(
                photographs[index], measures.sky, skies
            )
    for index, reason in {**find_beyond_gap(photographs), **_low(photographs)}.items():
        reasons[index] = reasons[index] or reason
    kept = [index for index, reason in enumerate(reasons) if reason is None]
    duplicates = _find_duplicates([photographs[i] for i in kept], [outlines[i] for i in kept], [sharp[i] for i in kept])
    for index, reason in duplicates.items():
        reasons[kept[index]] = reason
    found = zip(photographs, measured, reasons, strict=True)
    return tuple(QualityDecision(photograph.name, measures, reason) for photograph, measures, reason in found)


def select_photographs(survey: Survey, decisions: Sequence[QualityDecision], keep_all: bool = False) -> Survey:
    """Remove the photographs that are to be left out, their marks, and control points without marks.

    Args:
        decisions: on photographs of the survey; others are kept.
        keep_all: keep all photographs that can be decoded.

    Raises:
        SurveyError: fewer than three photographs are left.
    """
    out = [d for d in decisions if d.measures is None or (d.left_out is not None and not keep_all)]
    names = {decision.name for decision in out}
    selected = without(survey, names)
    if len(selected.photographs) < FEWEST:
        kinds = Counter((decision.left_out or "").partition(":")[0] for decision in out)
        counted = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        hint = "" if keep_all else ", or keep them all the same with --keep-all"
        dark = {decision.name for decision in out if (decision.left_out or "").startswith(("flat", "under-exposed"))}
        if any(one.name in dark and one.path.suffix.casefold() in _MAY_BE_DEEP for one in survey.photographs):
            hint += "; where values of 16 bits fill a small part of their range, stretch those of all files alike"
        raise SurveyError(
            f"{len(selected.photographs)} of the {len(survey.photographs)} photographs in {survey.folder} can be used "
            f"({counted}; such as {out[0].name}, {out[0].left_out}): expected at least {FEWEST}; take them again{hint}"
        )
    return selected


def without(survey: Survey, names: Collection[str]) -> Survey:
    """Remove photographs from a survey, their marks, and control points without marks."""
    photographs = tuple(photograph for photograph in survey.photographs if photograph.name not in names)
    control = survey.control
    if control is not None:
        marks = tuple(mark for mark in control.marks if mark.photograph not in names)
        marked = {mark.point for mark in marks}
        control = replace(control, marks=marks, points={k: v for k, v in control.points.items() if k in marked})
    return replace(survey, photographs=photographs, control=control)


def _measure(
    photographs: Sequence[Photograph], progress: Progress | None
) -> tuple[list[Measures | None], list[Int8[np.ndarray, "_ _"]], list[str | None]]:
    """Measures, outlines and reasons; of photographs that cannot be decoded, the reason alone."""

    def measure_one(photograph: Photograph) -> tuple[Measures | None, np.ndarray, str | None]:
        try:
            pixels = thumbnail(photograph, SIDE_PX)
            is_whole = photograph.mask is None and not photograph.has_alpha
            measures, small = measure(pixels, None if is_whole else used_pixels(photograph))
        except SurveyError as error:
            return None, np.zeros((16, 16), np.int8), f"undecodable: {error}"
        return measures, _outline(small), None

    found = []
    pool = ThreadPoolExecutor(min(8, cores()))
    try:
        for result in pool.map(measure_one, photographs):
            found.append(result)
            if progress:
                progress(len(found), len(photographs))
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits for the photographs in progress only
    return [measures for measures, _, _ in found], [o for _, o, _ in found], [reason for _, _, reason in found]


def _neighbours(photographs: Sequence[Photograph]) -> list[list[int]]:
    """The nearest photographs of each; in time where its position is unknown."""
    count = min(NEIGHBOURS, len(photographs) - 1)
    by_time = capture_order(photographs)
    near: list[list[int]] = [[] for _ in photographs]
    for rank, index in enumerate(by_time):
        first = max(0, min(rank - count // 2, len(by_time) - count - 1))
        near[index] = [other for other in by_time[first : first + count + 1] if other != index]
    xy_m = positions_m(photographs)
    located = np.flatnonzero(np.isfinite(xy_m[:, 0])).tolist()
    if len(located) > count:
        _, found = KDTree(xy_m[located]).query(xy_m[located], count + 1)
        for row, index in zip(found.reshape(len(located), -1), located, strict=True):
            near[index] = [located[other] for other in row if located[other] != index][:count]
    return near


def _median(values: Sequence[float]) -> float:
    """Median of the finite values; NaN if there are none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def _flat_or_badly_exposed(measures: Measures, neighbours: Sequence[Measures]) -> str | None:
    if measures.contrast < FLAT_CONTRAST:
        return (
            f"flat: 98% of the image lies within {measures.contrast:.1f} of 255 levels; a photograph of the ground has "
            f"{FLAT_CONTRAST:.0f} or more."
        )
    if measures.white > WHITE:
        return f"over-exposed: {measures.white:.0%} of it is white; {WHITE:.0%} is the limit."
    if measures.highlights < DARK_HIGHLIGHTS and measures.contrast < DARK_CONTRAST:
        return (
            f"under-exposed: 95% of it is darker than level {measures.highlights:.0f} of 255, and 98% lies within "
            f"{measures.contrast:.0f} levels; {DARK_HIGHLIGHTS:.0f} and {DARK_CONTRAST:.0f} are the limits."
        )
    usual = _median([other.light for other in neighbours])
    if measures.clipped > GLARING_CLIPPED and usual > 0 and measures.light > GLARING_LIGHT * usual:
        return (
            f"over-exposed: {measures.clipped:.0%} of it is clipped, and it has {measures.light / usual:.1f} times the "
            f"light of its {len(neighbours)} neighbours; {GLARING_CLIPPED:.0%} and {GLARING_LIGHT} times are the limit."
        )
    if measures.highlights < DIM_HIGHLIGHTS and measures.light < DIM_LIGHT * usual:
        return (
            f"under-exposed: it has {measures.light / usual:.0%} of the light of its {len(neighbours)} neighbours; "
            f"{DIM_LIGHT:.0%} is the limit."
        )
    return None


def _blurred(sharpness: float, usual: float, of_neighbours: float) -> str | None:
    """Compare the sharpness with fixed limits, with the median of its camera, and with that of its neighbours."""
    if math.isnan(sharpness):
        return None
    if usual > 0:
        to_survey, to_neighbours = sharpness / usual, sharpness / (of_neighbours if of_neighbours > 0 else usual)
        soft = sharpness < SOFT and to_neighbours < SOFT_OF_NEIGHBOURS and to_survey < SOFT_OF_SURVEY
        if soft or (to_neighbours < SOFTER_OF_NEIGHBOURS and to_survey < SOFTER_OF_SURVEY):
            limits = f"{SOFT} and {SOFT_OF_NEIGHBOURS:.0%}" if soft else f"{SOFTER_OF_NEIGHBOURS:.0%}"
            return (
                f"blurred: its sharpness is {sharpness:.3f}, {to_neighbours:.0%} of its neighbours' and "
                f"{to_survey:.0%} of the survey's; {limits} of the neighbours' is the limit."
            )
    if sharpness < HOPELESSLY_SOFT:
        return f"blurred: its sharpness is {sharpness:.3f}; {HOPELESSLY_SOFT} is the limit."
    return None


def _horizon(photograph: Photograph, sky: float, skies: int) -> str | None:
    """Use the gimbal pitch where the image confirms it (makers define it differently), else the image alone.

    Args:
        sky: share of the image.
        skies: number of the neighbours whose image is as much of a sky.
    """
    above = math.nan  # share of the image above the horizon, if the camera does not roll
    if photograph.gimbal_deg is not None:
        lens, pitch_deg = photograph.lens, min(89.0, max(-89.0, photograph.gimbal_deg[1]))
        focal_px = lens.focal_px if lens else _UNKNOWN_FOCAL * max(photograph.width, photograph.height)
        above = 0.5 + focal_px * math.tan(math.radians(pitch_deg)) / photograph.height
        above = min(1.0, max(0.0, above))
    if above > SKY_BELOW_HORIZON and sky > SKY_AT_LEAST:
        return f"horizon: {above:.0%} of it is above the horizon; {SKY_BELOW_HORIZON:.0%} is the limit."
    if math.isnan(above) and sky > SKY and skies < SKIES:
        return f"horizon: {sky:.0%} of it is sky; {SKY:.0%} is the limit."
    return None


def find_beyond_gap(photographs: Sequence[Photograph]) -> dict[int, str]:
    """Find the few photographs beyond a gap in the survey; returns the reason by index."""
    xy_m = positions_m(photographs)
    located = np.flatnonzero(np.isfinite(xy_m[:, 0])).tolist()
    xy_m = xy_m[located]
    if len(located) < 4:
        return {}
    nearest_m = float(np.median(KDTree(xy_m).query(xy_m, 2)[0][:, 1]))
    height_m = _flight_height_m(photographs)
    gap_m = max(
        _MIN_GAP_M, GAP_SPACINGS * nearest_m, GAP_HEIGHTS * height_m if height_m > 0 else _GAP_OF_UNKNOWN_HEIGHT_M
    )
    # Single linkage with distances shorter than a gap. Positions are rounded to an eighth of the gap first, because
    # thousands at one position would be millions of pairs.
    cells, cell_of = np.unique(np.round(xy_m * (_CELLS_IN_GAP / gap_m)), axis=0, return_inverse=True)
    pairs = KDTree(cells).query_pairs(_CELLS_IN_GAP, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    cluster = connected_components(graph, directed=False)[1][cell_of.reshape(-1)]
    sizes = np.bincount(cluster)
    largest = sizes.argmax()
    small = sizes <= max(1.0, min(MAX_FEW, FEW * len(located)))
    small[largest] = False
    if sizes[small].sum() > max(1.0, FEW_IN_ALL * len(located)):
        return {}
    away_m, _ = KDTree(xy_m[~small[cluster]]).query(xy_m)
    return {
        located[row]: f"off the survey: it was taken {away_m[row]:.0f} m from the nearest of the others; {gap_m:.0f} m "
        "is the limit."
        for row in np.flatnonzero(small[cluster])
    }


def _low(photographs: Sequence[Photograph]) -> dict[int, str]:
    usual_m = _flight_height_m(photographs)
    low = [index for index, p in enumerate(photographs) if p.relative_altitude_m < LOW * usual_m]
    if len(low) > max(1.0, FEW_LOW * len(photographs)):
        return {}
    return {
        index: f"off the survey: it was taken {photographs[index].relative_altitude_m:.0f} m above the take-off point, "
        f"the others at {usual_m:.0f} m; {LOW * usual_m:.0f} m is the limit."
        for index in low
    }


def _flight_height_m(photographs: Sequence[Photograph]) -> float:
    return _median([p.relative_altitude_m for p in photographs if p.relative_altitude_m > 0])


def _find_duplicates(
    photographs: Sequence[Photograph], outlines: Sequence[Int8[np.ndarray, "_ _"]], sharpness: Sequence[float]
) -> dict[int, str]:
    """Find the photographs of which a sharper duplicate exists.

    Compared are photographs taken within 3 m (or 5% of the flight height) of each other; and, if their positions are
    unknown or within 20 m, those within three of each other in time or with similar coarse outlines.

    Returns:
        The reason by index of the photograph.
    """
    coarse = np.array([_coarse(outline) for outline in outlines], np.float32).reshape(-1, _COARSE[0] * _COARSE[1])
    order = sorted(range(len(photographs)), key=lambda i: (-(sharpness[i] if sharpness[i] > 0 else 0.0), i))
    rank = np.argsort(np.array(capture_order(photographs), dtype=np.int64))
    xy_m = positions_m(photographs)
    kept: list[int] = []
    reasons = {}
    for index in order:
        others = np.array(kept, dtype=np.int64)
        height_m = photographs[index].relative_altitude_m
        near_m = max(_NEAR_M, _NEAR_OF_HEIGHT * height_m if height_m > 0 else 0.0)
        away_m = np.linalg.norm(xy_m[others] - xy_m[index], axis=1)  # NaN where a position is unknown
        likely = (np.abs(rank[others] - rank[index]) <= _IN_SEQUENCE) | (
            coarse[others] @ coarse[index] > _MIN_CORRELATION
        )
        for other in others[(away_m < near_m) | (likely & ~(away_m > _FAR_M))].tolist():
            if outlines[other].shape != outlines[index].shape:
                continue
            shift, agree = _agreement(outlines[index], outlines[other])
            if shift < MAX_SHIFT and agree > MIN_AGREEMENT:
                reasons[index] = (
                    f"duplicate: it has the view of {photographs[other].name}, shifted by {shift:.1%} of its longer "
                    f"side (agreement {agree:.2f}); {MAX_SHIFT:.0%} (and {MIN_AGREEMENT}) is the limit."
                )
                break
        else:
            kept.append(index)
    return reasons


def capture_order(photographs: Sequence[Photograph]) -> list[int]:
    """Indices of photographs by time of capture, then by name; those without time first."""
    times = [photograph.time_s if math.isfinite(photograph.time_s) else 0.0 for photograph in photographs]
    return sorted(range(len(photographs)), key=lambda i: (times[i], photographs[i].name))


def _outline(thumbnail: Float32[np.ndarray, "h w"]) -> Int8[np.ndarray, "h w"]:
    """Band-pass the log brightness of a grey thumbnail and normalise its contrast, so that exposure does not matter."""
    bright = np.log(thumbnail + 8)
    middle = cv2.GaussianBlur(bright, (0, 0), 1.5) - cv2.GaussianBlur(bright, (0, 0), 8)
    normalised = middle / np.sqrt(cv2.blur(middle * middle, (25, 25)) + 1e-4)  # the constant keeps flat regions flat
    return np.clip(np.round(normalised * 32), -127, 127).astype(np.int8)


def _agreement(first: Int8[np.ndarray, "h w"], second: Int8[np.ndarray, "h w"]) -> tuple[float, float]:
    """Register two outlines; returns their shift, in longer sides, and their agreement after it.

    The shift is found by phase correlation. The agreement is the median correlation of blocks of 20 pixels, 1 for equal
    outlines. Roads and shores of the same direction agree in some blocks only.
    """
    a, b = first.astype(np.float32), second.astype(np.float32)
    right, down = _phase_correlation(a, b)
    move = np.array([[1, 0, right], [0, 1, down]], np.float32)
    moved = cv2.warpAffine(b, move, b.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    margin = 1 + math.ceil(max(abs(right), abs(down), 3))
    shift = math.hypot(right, down) / max(a.shape)
    if min(a.shape) < 2 * margin + _BLOCK:
        return shift, 0.0
    cells = []
    for image in (a, moved):
        inner = image[margin:-margin, margin:-margin]
        rows, columns = inner.shape[0] // _BLOCK, inner.shape[1] // _BLOCK
        whole = inner[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
        cell = whole.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
        cells.append(cell - cell.mean(axis=1, keepdims=True))
    energy = np.sqrt((cells[0] ** 2).sum(axis=1) * (cells[1] ** 2).sum(axis=1))
    return shift, float(np.median((cells[0] * cells[1]).sum(axis=1) / (energy + 1.0)))


def _phase_correlation(a: Float32[np.ndarray, "h w"], b: Float32[np.ndarray, "h w"]) -> tuple[float, float]:
    """Shift to the right and down in pixels, with b(x + shift) = a(x).

    `cv2.phaseCorrelate` is three times as fast, but 0.1 pixels off where this is 0.02 off: its peak is a centroid.
    """
    height, width = a.shape
    window = np.hanning(height)[:, None] * np.hanning(width)
    spectrum = np.fft.rfft2(a * window).conj() * np.fft.rfft2(b * window)
    size = np.abs(spectrum)
    # The constants keep frequencies that neither has from weighing as much as the others.
    surface = np.fft.irfft2(spectrum / (size + 1e-9 * size.max() + 1e-30), a.shape)
    surface: Float[np.ndarray, "h w"] = cv2.GaussianBlur(np.fft.fftshift(surface), (0, 0), 0.8)
    y, x = np.unravel_index(surface.argmax(), surface.shape)

    def between(before: float, peak: float, after: float) -> float:
        curvature = before - 2 * peak + after
        return 0.0 if curvature == 0 else float(np.clip((before - after) / (2 * curvature), -0.5, 0.5))

    right = between(surface[y, x - 1], surface[y, x], surface[y, (x + 1) % width])
    down = between(surface[y - 1, x], surface[y, x], surface[(y + 1) % height, x])
    return float(x + right - width // 2), float(y + down - height // 2)


def _coarse(outline: Int8[np.ndarray, "h w"]) -> Float32[np.ndarray, " 192"]:
    """A reduced outline of unit norm, insensitive to shifts of a fiftieth."""
    small = cv2.resize(outline.astype(np.float32), _COARSE, interpolation=cv2.INTER_AREA).ravel()
    small = small - small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)  # a flat one correlates with none
