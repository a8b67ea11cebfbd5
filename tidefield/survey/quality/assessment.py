"""Assess which photographs would degrade a scene, from their measures and those of their neighbours.

Every limit is a constant here and is stated in the reason, with the measure. No file is deleted; `select_photographs`
leaves photographs out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tidefield.errors import SurveyError
from tidefield.machine import cores
from tidefield.survey.io.image_decoding import thumbnail
from tidefield.survey.io.photographs import FEWEST
from tidefield.survey.io.positions import positions_m
from tidefield.survey.quality.duplicates import capture_order, find_duplicates, outline
from tidefield.survey.quality.measures import SIDE_PX, Measures, measure
from tidefield.survey.survey import Photograph, Survey

NEIGHBOURS = 6
"""Number of photographs, the nearest in position or else in time, with which one is compared."""

FLAT_CONTRAST = 10.0
DARK_HIGHLIGHTS = 60.0
DIM_HIGHLIGHTS, DIM_LIGHT = 80.0, 0.15  # of the light of the neighbours
WHITE = 0.2
GLARING_CLIPPED, GLARING_LIGHT = 0.2, 3.5  # times the light of the neighbours
# A blur of six pixels reduces sharpness to 0.05 to 0.11, both of a soft lens (0.2) and of a crisp one (0.5); a blur of
# three pixels, which does not harm a scene, to 0.12 and more.
SOFT, SOFT_OF_NEIGHBOURS, SOFT_OF_SURVEY = 0.11, 0.65, 0.7
SOFTER_OF_NEIGHBOURS, SOFTER_OF_SURVEY = 0.4, 0.35
HOPELESSLY_SOFT = 0.035
SKY, SKY_BELOW_HORIZON, SKY_AT_LEAST = 0.35, 0.3, 0.1

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
_CELLS_IN_GAP = 8.0
_UNKNOWN_FOCAL = 0.75  # of the longer side


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


def assess_quality(survey: Survey, progress: Callable[[int, int], None] | None = None) -> tuple[QualityDecision, ...]:
    """Decide on all photographs, in their order.

    Decodes one reduced image per processor at a time; about 20 kB of each are kept until the end.

    Args:
        survey: the photographs.
        progress: called with the number of photographs that are measured, and of all.
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
            reasons[index] = _blurred(sharp[index], of_kind[kinds[index]], of_neighbours) or _horizon(
                photographs[index], measures
            )
    for index, reason in {**find_beyond_gap(photographs), **_low(photographs)}.items():
        reasons[index] = reasons[index] or reason
    kept = [index for index, reason in enumerate(reasons) if reason is None]
    duplicates = find_duplicates([photographs[i] for i in kept], [outlines[i] for i in kept], [sharp[i] for i in kept])
    for index, reason in duplicates.items():
        reasons[kept[index]] = reason
    found = zip(photographs, measured, reasons, strict=True)
    return tuple(QualityDecision(photograph.name, measures, reason) for photograph, measures, reason in found)


def select_photographs(survey: Survey, decisions: Sequence[QualityDecision], keep_all: bool = False) -> Survey:
    """Remove the photographs that are to be left out, their marks, and control points without marks.

    Args:
        survey: the survey that was assessed.
        decisions: on all its photographs.
        keep_all: keep all photographs that can be decoded.

    Raises:
        SurveyError: fewer than three photographs are left.
    """
    out = [d for d in decisions if d.measures is None or (d.left_out is not None and not keep_all)]
    names = {decision.name for decision in out}
    photographs = tuple(photograph for photograph in survey.photographs if photograph.name not in names)
    if len(photographs) < FEWEST:
        kinds = Counter((decision.left_out or "").partition(":")[0] for decision in out)
        counted = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        hint = "" if keep_all else ", or keep them all the same with --keep-all"
        raise SurveyError(
            f"{len(photographs)} of the {len(decisions)} photographs in {survey.folder} can be used ({counted}; such "
            f"as {out[0].name}, {out[0].left_out}): expected at least {FEWEST}; take them again{hint}"
        )
    control = survey.control
    if control is not None:
        marks = tuple(mark for mark in control.marks if mark.photograph not in names)
        marked = {mark.point for mark in marks}
        control = replace(control, marks=marks, points={k: v for k, v in control.points.items() if k in marked})
    return replace(survey, photographs=photographs, control=control)


def _measure(
    photographs: Sequence[Photograph], progress: Callable[[int, int], None] | None
) -> tuple[list[Measures | None], list[Int8[np.ndarray, "_ _"]], list[str | None]]:
    """Measures, outlines and reasons; of photographs that cannot be decoded, the reason alone."""

    def measure_one(photograph: Photograph) -> tuple[Measures | None, np.ndarray, str | None]:
        try:
            measures, small = measure(thumbnail(photograph, SIDE_PX))
        except SurveyError as error:
            return None, np.zeros((16, 16), np.int8), f"undecodable: {error}"
        return measures, outline(small), None

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
    if measures.highlights < DARK_HIGHLIGHTS:
        return (
            f"under-exposed: 95% of it is darker than level {measures.highlights:.0f} of 255; "
            f"{DARK_HIGHLIGHTS:.0f} is the limit."
        )
    usual = _median([other.light for other in neighbours])
    if measures.clipped > GLARING_CLIPPED and measures.light > GLARING_LIGHT * usual:
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
    to_survey, to_neighbours = sharpness / usual, sharpness / (of_neighbours if of_neighbours > 0 else usual)
    soft = sharpness < SOFT and to_neighbours < SOFT_OF_NEIGHBOURS and to_survey < SOFT_OF_SURVEY
    if soft or (to_neighbours < SOFTER_OF_NEIGHBOURS and to_survey < SOFTER_OF_SURVEY):
        limits = f"{SOFT} and {SOFT_OF_NEIGHBOURS:.0%}" if soft else f"{SOFTER_OF_NEIGHBOURS:.0%}"
        return (
            f"blurred: its sharpness is {sharpness:.3f}, {to_neighbours:.0%} of its neighbours' and {to_survey:.0%} of "
            f"the survey's; {limits} of the neighbours' is the limit."
        )
    if sharpness < HOPELESSLY_SOFT:
        return f"blurred: its sharpness is {sharpness:.3f}; {HOPELESSLY_SOFT} is the limit."
    return None


def _horizon(photograph: Photograph, measures: Measures) -> str | None:
    """Use the gimbal pitch where the image confirms it (makers define it differently), else the image alone."""
    above = math.nan  # share of the image above the horizon, if the camera does not roll
    if photograph.gimbal_deg is not None:
        lens, pitch_deg = photograph.lens, min(89.0, max(-89.0, photograph.gimbal_deg[1]))
        focal_px = lens.focal_px if lens else _UNKNOWN_FOCAL * max(photograph.width, photograph.height)
        above = 0.5 + focal_px * math.tan(math.radians(pitch_deg)) / photograph.height
        above = min(1.0, max(0.0, above))
    if above > SKY_BELOW_HORIZON and measures.sky > SKY_AT_LEAST:
        return f"horizon: {above:.0%} of it is above the horizon; {SKY_BELOW_HORIZON:.0%} is the limit."
    if math.isnan(above) and measures.sky > SKY:
        return f"horizon: {measures.sky:.0%} of it is sky; {SKY:.0%} is the limit."
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
    gap_m = max(_MIN_GAP_M, GAP_SPACINGS * nearest_m, GAP_HEIGHTS * height_m if height_m > 0 else 0.0)
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
    away_m, _ = KDTree(xy_m[cluster == largest]).query(xy_m)
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
