"""Hold what the pipeline found: the input of the report, plain values that the stages fill in."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, UInt8

from tidefield.data.georeference import Georeference, Residuals
from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.survey import Survey


@dataclass(frozen=True)
class UnusedPhotograph:
    """A photograph that is not in the model.

    Attributes:
        name: `Photograph.name`.
        stage: where it was left out: not readable, rejected for its quality, or not registered.
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
    """A measure before and after the colour correction."""

    what: str
    before: float
    after: float
    unit: str


@dataclass(frozen=True)
class ColourExample:
    """One photograph before and after the colour correction, small."""

    name: str
    before: UInt8[np.ndarray, "h w 3"]
    after: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class ColourCorrection:
    """What the colour correction did.

    Attributes:
        applied: whether the scene's photographs were corrected.
        verdict: a sentence with the reason.
        changes: measures before and after.
        examples: photographs before and after, the most changed first.
    """

    applied: bool
    verdict: str
    changes: tuple[Change, ...]
    examples: tuple[ColourExample, ...] = ()


@dataclass(frozen=True)
class Comparison:
    """Positions in the model against those that were given.

    Attributes:
        kind: GPS of the cameras; control points that the model was fitted to; points held out of that.
        title: what is compared, in words.
        residuals: the model's minus the given.
        used: whether each takes part in the statistics; the others are wrong, or unknown.
        remarks: whole sentences, such as which marks were left out and why.
    """

    kind: Literal["gps", "control", "check"]
    title: str
    residuals: Residuals
    used: Bool[np.ndarray, " P"]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Findings:
    """Everything that the report describes.

    Attributes:
        title: name of the survey.
        date: when the scene was made.
        survey: what was read; may hold photographs that are not in the model.
        reconstruction: the model, image names as `Photograph.name`; in the world (z up, metres) where it has a frame,
            else in any frame and unit.
        georeference: position of the world on the Earth, and its accuracy.
        left_out: photographs that are not in the model.
        models: number of photographs of each model that was found; the reconstruction is the first.
        colour: what the colour correction did, or None if it was not tried.
        seconds: wall time by stage, in order.
        options: of the command, as text.
        versions: of the programs.
        remarks: whole sentences that a reader should know, the most important first.
    """

    title: str
    date: datetime
    survey: Survey
    reconstruction: pycolmap.Reconstruction
    georeference: Georeference
    left_out: tuple[UnusedPhotograph, ...] = ()
    models: tuple[int, ...] = ()
    colour: ColourCorrection | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def frame(self) -> LocalFrame | None:
        """Position of the world on the Earth, or None."""
        return self.georeference.frame

    @property
    def placed_by(self) -> str:
        """What the georeference rests on, such as "5 control points, GPS of 79 photographs"."""
        located = self.georeference
        gps = f"GPS of {len(located.gps_used.names)} photographs"
        if located.source == "ground control":
            return f"{len(located.control.names)} control points" + (f", {gps}" if located.gps_used.names else "")
        return gps if located.source == "GPS" else ""

    def comparisons(self) -> tuple[Comparison, ...]:
        """Residuals of GPS, control and check points, those that there are."""
        located = self.georeference
        rejected = {item.name: f"{item.name}: {item.reason}" for item in located.left_out if item.kind == "GPS"}
        trusted = np.array([name not in rejected for name in located.gps.names], dtype=bool)
        found = [Comparison("gps", "GPS of the cameras", located.gps, trusted, tuple(rejected.values()))]
        if located.source == "ground control" and self.survey.control is not None and located.frame is not None:
            marks = tuple(f"{item.name}: {item.reason}" for item in located.left_out if item.kind != "GPS")
            check = "Control points, each left out in turn"
            found += [
                Comparison("control", "Control points", located.control, located.control.known, marks),
                Comparison("check", check, located.check, located.check.known),
            ]
        return tuple(comparison for comparison in found if comparison.residuals.names)

    def control_points(self) -> dict[str, Float64[np.ndarray, " 3"]]:
        """Surveyed world positions of the control and check points that are compared."""
        names = [name for c in self.comparisons() if c.kind != "gps" for name in c.residuals.names]
        if not names:
            return {}
        assert self.survey.control is not None, "comparisons() lists points of a control file only"
        assert self.frame is not None, "comparisons() lists located points only"
        given = np.array([self.survey.control.points[name] for name in names], dtype=np.float64)
        return dict(zip(names, self.frame.from_system(self.survey.control.crs, given), strict=True))
