"""Which photographs of a survey do it more harm than good, and why: measured one by one, judged by the others.

Every limit is stated here and again in the reason, with what was measured. Nothing is deleted; `keep` leaves out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int8
from scipy.spatial import KDTree

from tidefield.errors import SurveyError
from tidefield.machine import cores
from tidefield.survey.io.photographs import FEWEST
from tidefield.survey.io.image_decoding import thumbnail
from tidefield.survey.io.positions import metres_around
from tidefield.survey.quality.duplicates import duplicates
from tidefield.survey.quality.measures import SIDE_PX, Measures, measure
from tidefield.survey.quality.off_survey import off_survey
from tidefield.survey.survey import Photograph, Survey

NEIGHBOURS = 6
"""Photographs, the nearest in place or else in time, that one is compared with."""

FLAT_CONTRAST = 10.0
DARK_HIGHLIGHTS = 60.0
DIM_HIGHLIGHTS, DIM_LIGHT = 80.0, 0.15  # of the neighbours' light
WHITE = 0.2
GLARING_CLIPPED, GLARING_LIGHT = 0.2, 3.5  # times the neighbours' light
# A blur of six pixels brings sharpness to 0.05 to 0.11, that of a soft lens (0.2) as that of a crisp one (0.5); a blur
# of three pixels, which a scene survives, to 0.12 and more.
SOFT, SOFT_OF_NEIGHBOURS, SOFT_OF_SURVEY = 0.11, 0.65, 0.7
SOFTER_OF_NEIGHBOURS, SOFTER_OF_SURVEY = 0.4, 0.35
HOPELESSLY_SOFT = 0.035
SKY, SKY_BELOW_HORIZON, SKY_AT_LEAST = 0.35, 0.3, 0.1

_UNKNOWN_FOCAL = 0.75  # of the longer side

Progress = Callable[[int, int], None]
"""Called with how many photographs are measured, and of how many."""


@dataclass(frozen=True)
class Verdict:
    """What was found of one photograph.

    Attributes:
        name: of the photograph.
        measures: None if it cannot be decoded; then it is left out whatever is asked for.
        left_out: why it should be, in a sentence with the measure and its limit; None if it should be kept.
    """

    name: str
    measures: Measures | None
    left_out: str | None


def judge(survey: Survey, progress: Progress | None = None) -> tuple[Verdict, ...]:
    """Verdicts on all photographs, in their order.

    Looks at one reduced picture per processor at a time; of each some 20 kB are kept until the end.
    """
    photographs = survey.photographs
    measured, outlines, reasons = _measure(photographs, progress)
    near = _neighbours(photographs)
    for index, measures in enumerate(measured):
        if measures is not None:
            beside = [other for other in (measured[i] for i in near[index]) if other is not None]
            reasons[index] = _flat(measures) or _exposed(measures, beside)
    # What is no picture of the ground must not be what the others are compared with.
    sharp = [_sharpness(None if reason else measures) for measures, reason in zip(measured, reasons, strict=True)]
    usual = _usual(photographs, sharp)
    for index, measures in enumerate(measured):
        if measures is not None and reasons[index] is None:
            around = _median([sharp[i] for i in near[index]])
            reasons[index] = _blurred(sharp[index], usual[index], around) or _horizon(photographs[index], measures)
    for index, reason in off_survey(photographs).items():
        reasons[index] = reasons[index] or reason
    kept = [index for index, reason in enumerate(reasons) if reason is None]
    reasons_of_kept = duplicates(
        [photographs[i] for i in kept],
        [outlines[i] for i in kept],
        [_sharpness(measured[i]) for i in kept],
    )
    for index, reason in reasons_of_kept.items():
        reasons[kept[index]] = reason
    found = zip(photographs, measured, reasons, strict=True)
    return tuple(Verdict(photograph.name, measures, reason) for photograph, measures, reason in found)


def keep(survey: Survey, verdicts: Sequence[Verdict], keep_all: bool = False) -> Survey:
    """The survey with those photographs only that no verdict leaves out, and control with their marks only.

    Args:
        survey: what was judged.
        verdicts: of all its photographs.
        keep_all: keep also those that a verdict leaves out, if they can be decoded.

    Raises:
        SurveyError: fewer than three photographs are left.
    """
    out = [v for v in verdicts if v.measures is None or (v.left_out is not None and not keep_all)]
    names = {verdict.name for verdict in out}
    photographs = tuple(photograph for photograph in survey.photographs if photograph.name not in names)
    if len(photographs) < FEWEST:
        kinds = Counter((verdict.left_out or "").partition(":")[0] for verdict in out)
        counted = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        first = out[0]
        hint = "" if keep_all else ", or keep them all the same with --keep-all"
        raise SurveyError(
            f"{len(photographs)} of the {len(verdicts)} photographs in {survey.folder} can be used ({counted}; such as "
            f"{first.name}, {first.left_out}): expected at least {FEWEST}; take them again{hint}"
        )
    control = survey.control
    if control is not None:
        marks = tuple(mark for mark in control.marks if mark.photograph not in names)
        marked = {mark.point for mark in marks}
        control = replace(control, marks=marks, points={k: v for k, v in control.points.items() if k in marked})
    return replace(survey, photographs=photographs, control=control)


def _measure(
    photographs: Sequence[Photograph], progress: Progress | None
) -> tuple[list[Measures | None], list[Int8[np.ndarray, "_ _"] | None], list[str | None]]:
    def look(photograph: Photograph) -> tuple[Measures, np.ndarray] | str:
        try:
            return measure(thumbnail(photograph, SIDE_PX))
        except SurveyError as error:
            return f"undecodable: {error}"

    measured, outlines, reasons = [], [], []
    pool = ThreadPoolExecutor(min(8, cores()))
    try:
        for done, found in enumerate(pool.map(look, photographs), start=1):
            measures, outline = (None, None) if isinstance(found, str) else found
            measured.append(measures)
            outlines.append(outline)
            reasons.append(found if isinstance(found, str) else None)
            if progress:
                progress(done, len(photographs))
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits for the photographs in hand, not for all
    return measured, outlines, reasons


def _neighbours(photographs: Sequence[Photograph]) -> list[list[int]]:
    """Of each photograph those taken nearest by; in time where its position is unknown."""
    count = min(NEIGHBOURS, len(photographs) - 1)
    by_time = sorted(
        range(len(photographs)),
        key=lambda i: (photographs[i].time_s if math.isfinite(photographs[i].time_s) else 0.0, photographs[i].name),
    )
    near: list[list[int]] = [[] for _ in photographs]
    for rank, index in enumerate(by_time):
        first = max(0, min(rank - count // 2, len(by_time) - count - 1))
        near[index] = [other for other in by_time[first : first + count + 1] if other != index]
    located = [index for index, photograph in enumerate(photographs) if photograph.position is not None]
    if len(located) > count:
        xy_m: Float64[np.ndarray, "N 2"] = metres_around([p.position for p in photographs if p.position is not None])
        _, found = KDTree(xy_m).query(xy_m, count + 1)
        for row, index in zip(found.reshape(len(located), -1), located, strict=True):
            near[index] = [located[other] for other in row if located[other] != index][:count]
    return near


def _usual(photographs: Sequence[Photograph], values: Sequence[float]) -> list[float]:
    """For each photograph the median over all of its camera and size."""
    kinds = [(p.camera, min(p.width, p.height), max(p.width, p.height)) for p in photographs]
    by_kind: dict[tuple[str, int, int], list[float]] = {}
    for kind, value in zip(kinds, values, strict=True):
        by_kind.setdefault(kind, []).append(value)
    median = {kind: _median(several) for kind, several in by_kind.items()}
    return [median[kind] for kind in kinds]


def _flat(measures: Measures) -> str | None:
    if measures.contrast >= FLAT_CONTRAST:
        return None
    return (
        f"flat: 98% of the picture lies within {measures.contrast:.1f} of 255 levels; a photograph of the ground has "
        f"{FLAT_CONTRAST:.0f} or more."
    )


def _exposed(measures: Measures, beside: Sequence[Measures]) -> str | None:
    if measures.white > WHITE:
        return f"over-exposed: {measures.white:.0%} of it is white; {WHITE:.0%} is the limit."
    if measures.highlights < DARK_HIGHLIGHTS:
        return (
            f"under-exposed: 95% of it is darker than level {measures.highlights:.0f} of 255; "
            f"{DARK_HIGHLIGHTS:.0f} is the limit."
        )
    around = float(np.median([other.light for other in beside])) if beside else math.nan
    if measures.clipped > GLARING_CLIPPED and measures.light > GLARING_LIGHT * around:
        return (
            f"over-exposed: {measures.clipped:.0%} of it is clipped, and it has {measures.light / around:.1f} times "
            f"the light of its {len(beside)} neighbours; {GLARING_CLIPPED:.0%} and {GLARING_LIGHT} times are the limit."
        )
    if measures.highlights < DIM_HIGHLIGHTS and measures.light < DIM_LIGHT * around:
        return (
            f"under-exposed: it has {measures.light / around:.0%} of the light of its {len(beside)} neighbours; "
            f"{DIM_LIGHT:.0%} is the limit."
        )
    return None


def _sharpness(measures: Measures | None) -> float:
    return math.nan if measures is None else measures.sharpness


def _blurred(sharpness: float, survey: float, around: float) -> str | None:
    """By its own sharpness, the survey's and its neighbours', where these are known."""
    if math.isnan(sharpness):
        return None
    of_survey, of_neighbours = sharpness / survey, sharpness / (around if around > 0 else survey)
    soft = sharpness < SOFT and of_neighbours < SOFT_OF_NEIGHBOURS and of_survey < SOFT_OF_SURVEY
    if soft or (of_neighbours < SOFTER_OF_NEIGHBOURS and of_survey < SOFTER_OF_SURVEY):
        limits = f"{SOFT} and {SOFT_OF_NEIGHBOURS:.0%}" if soft else f"{SOFTER_OF_NEIGHBOURS:.0%}"
        return (
            f"blurred: its sharpness is {sharpness:.3f}, {of_neighbours:.0%} of its neighbours' and {of_survey:.0%} of "
            f"the survey's; {limits} of the neighbours' is the limit."
        )
    if sharpness < HOPELESSLY_SOFT:
        return f"blurred: its sharpness is {sharpness:.3f}; {HOPELESSLY_SOFT} is the limit."
    return None


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


def _horizon(photograph: Photograph, measures: Measures) -> str | None:
    """By the gimbal's pitch where the picture bears it out (makers count it differently), else by the picture alone."""
    above = _above_horizon(photograph)
    if above > SKY_BELOW_HORIZON and measures.sky > SKY_AT_LEAST:
        return f"horizon: {above:.0%} of it looks above the horizon; {SKY_BELOW_HORIZON:.0%} is the limit."
    if math.isnan(above) and measures.sky > SKY:
        return f"horizon: {measures.sky:.0%} of it is sky; {SKY:.0%} is the limit."
    return None


def _above_horizon(photograph: Photograph) -> float:
    """Share of the picture, if its camera does not roll; NaN where its pitch is unknown."""
    if photograph.gimbal_deg is None:
        return math.nan
    lens, side = photograph.lens, max(photograph.width, photograph.height)
    focal_px = lens.focal_px if lens else _UNKNOWN_FOCAL * side
    pitch = math.radians(min(89.0, max(-89.0, photograph.gimbal_deg[1])))
    return min(1.0, max(0.0, 0.5 + focal_px * math.tan(pitch) / photograph.height))
