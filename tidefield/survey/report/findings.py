"""What the pipeline found, as the report needs it: plain values that the other stages fill in."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, UInt8

from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.survey import Survey


@dataclass(frozen=True)
class Residuals:
    """Distances between where things were found and where they are said to be.

    Attributes:
        kind: receiver positions of the cameras; control points that the model was fitted to; points held out of that.
        title: what is compared, in words, such as "Control points, each left out in turn".
        names: photographs or points.
        east_north_up_m: found minus stated; NaN where nothing was found.
        stated_world: where they are said to be.
        used: whether each took part in the statistics; the others were found to be wrong, or not at all.
        remarks: whole sentences, such as which marks were left out and why.
    """

    kind: Literal["gps", "control", "check"]
    title: str
    names: tuple[str, ...]
    east_north_up_m: Float64[np.ndarray, "P 3"]
    stated_world: Float64[np.ndarray, "P 3"]
    used: Bool[np.ndarray, " P"]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class LeftOut:
    """A photograph that is not in the model.

    Attributes:
        name: `Photograph.name`.
        stage: where it was lost: not readable, judged unfit, or found no place in the model.
        reason: in words, with the measure and its limit where there is one.
        measures: by name, for report.json.
        thumbnail: a small upright copy, or None.
    """

    name: str
    stage: Literal["reading", "quality", "poses"]
    reason: str
    measures: dict[str, float] = field(default_factory=dict)
    thumbnail: UInt8[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True)
class Change:
    """A measure before and after colour evening."""

    what: str
    before: float
    after: float
    unit: str


@dataclass(frozen=True)
class ColourExample:
    """One photograph before and after colour evening, small."""

    name: str
    before: UInt8[np.ndarray, "h w 3"]
    after: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class ColourEvening:
    """What colour evening did.

    Attributes:
        applied: whether the scene's photographs were evened.
        verdict: a sentence that says why, or why not.
        changes: measures before and after.
        examples: photographs before and after, worst first.
    """

    applied: bool
    verdict: str
    changes: tuple[Change, ...]
    examples: tuple[ColourExample, ...] = ()


@dataclass(frozen=True)
class Findings:
    """Everything that the report tells.

    Attributes:
        title: name of the survey.
        date: when the scene was made.
        survey: what was read; may hold photographs that are not in the model.
        reconstruction: the model, image names as `Photograph.name`; World (z up, metres) where `frame` is known,
            else any frame and unit.
        frame: where World lies on the Earth, or None.
        placed_by: what placed it there, such as "GPS of 79 photographs, 5 control points".
        residuals: of GPS, control and check points.
        left_out: photographs that are not in the model.
        models: number of photographs of each model that was found; the reconstruction is the first.
        colour: what colour evening did, or None if it was not tried.
        seconds: wall time by stage, in order.
        options: what was asked for, as text.
        versions: of the programs.
        remarks: whole sentences that a reader should know, the most important first.
    """

    title: str
    date: datetime
    survey: Survey
    reconstruction: pycolmap.Reconstruction
    frame: LocalFrame | None
    placed_by: str = ""
    residuals: tuple[Residuals, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    models: tuple[int, ...] = ()
    colour: ColourEvening | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
