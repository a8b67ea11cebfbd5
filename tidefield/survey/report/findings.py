"""Collect what the pipeline found: the input of the report."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, UInt8

from tidefield import __version__
from tidefield.data.georeference import Georeference, Residuals
from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.colour import ExposureCorrection
from tidefield.survey.io.image_decoding import thumbnail
from tidefield.survey.prepare import Prepared
from tidefield.survey.sfm.features import decode_name
from tidefield.survey.sfm.mapping import FEW_FEATURES, lens_notes
from tidefield.survey.sfm.model_files import read_model
from tidefield.survey.survey import Survey

MOST_THUMBNAILS = 24  # of each stage
THUMBNAIL_PX = 160
EXAMPLES = 3  # photographs that are shown before and after the colour correction
EXAMPLE_PX = 200

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class UnusedPhotograph:
    """A photograph that is not in the model.

    Attributes:
        name: `Photograph.name`.
        stage: where it was left out: rejected for its quality, or not registered.
        reason: in words, with the measure and its limit where there is one.
        measures: by name, for report.json.
        thumbnail: a small upright copy, or None.
    """

    name: str
    stage: Literal["quality", "poses"]
    reason: str
    measures: dict[str, float] = field(default_factory=dict)
    thumbnail: Picture | None = None


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
        survey: what was read; holds photographs that are not in the model, too.
        reconstruction: the model, image names as `Photograph.name`; in the world (z up, metres) where it has a frame,
            else in any frame and unit.
        georeference: position of the world on the Earth, and its accuracy.
        left_out: photographs that are not in the model.
        models: number of photographs of each model that was found; the reconstruction is the first.
        held_out: names of photographs of the reconstruction that were placed afterwards, and observe no points.
        colour: the colour correction, or None if it was not tried, or could not be measured.
        examples: name and small pictures before and after the correction, the most changed first.
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
    held_out: frozenset[str] = frozenset()
    colour: ExposureCorrection | None = None
    examples: tuple[tuple[str, Picture, Picture], ...] = ()
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
        """What the georeference rests on, such as "2 control points, GPS of 79 photographs"."""
        located, used = self.georeference, {*self.georeference.gps_used.names}
        gps = f"GPS of {len(used)} photographs"
        if located.source != "ground control":
            return gps if located.source == "GPS" else ""
        count = len(located.control_world)
        return f"{count} control point{'s'[: count != 1]}" + (f", {gps}" if used and located.gps_has_part else "")

    def comparisons(self) -> tuple[Comparison, ...]:
        """Residuals of GPS, control and check points, those that there are."""
        located = self.georeference
        rejected = {item.name: f"{item.name}: {item.reason}" for item in located.left_out if item.kind == "GPS"}
        trusted = np.array([name not in rejected for name in located.gps.names], dtype=bool)
        found = [Comparison("gps", "GPS of the cameras", located.gps, trusted, tuple(rejected.values()))]
        if located.source == "ground control":
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
        assert self.survey.control is not None, "the model was fitted to a control file"
        assert self.frame is not None, "ground control gives a frame"
        given = np.array([self.survey.control.points[name] for name in names], dtype=np.float64)
        return dict(zip(names, self.frame.from_system(self.survey.control.crs, given), strict=True))


def collect_findings(prepared: Prepared, scene: Path, options: Mapping[str, str]) -> Findings:
    """Collect everything that the report of a prepared scene describes."""
    correction = prepared.correction
    if correction is not None and math.isnan(correction.before):
        correction = None
    return Findings(
        title=os.fsencode(prepared.survey.folder.resolve().name).decode(errors="replace"),
        date=datetime.now(UTC),
        survey=prepared.survey,
        reconstruction=read_model(scene / "sparse" / "0"),
        georeference=prepared.georeference,
        left_out=tuple(
            replace(lost, reason=_without_folder(lost.reason, prepared.survey.folder))
            for lost in (*_rejected(prepared), *_unregistered(prepared, scene))
        ),
        models=tuple(len(names) for names in prepared.models),
        held_out=prepared.held_out,
        colour=correction,
        examples=_examples(prepared, scene, correction) if correction and correction.helps else (),
        seconds=prepared.seconds,
        options=dict(options),
        versions={
            "tidefield": __version__,
            "pycolmap": pycolmap.__version__,
            "Python": platform.python_version(),
        },
        remarks=tuple(
            _without_folder(remark, prepared.survey.folder)
            for remark in (
                *prepared.georeference.notes,
                *lens_notes(prepared.lens, prepared.survey.photographs),
                *prepared.survey.remarks,
            )
        ),
    )


def _without_folder(text: str, folder: Path) -> str:
    """Shorten paths to names relative to the photographs' folder: a report is sent on."""
    return text.replace(f"{folder}{os.sep}", "")


def _rejected(prepared: Prepared) -> list[UnusedPhotograph]:
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    found = []
    for verdict in prepared.verdicts:
        if not verdict.left_out or verdict.name in prepared.used:
            continue
        measures = {} if verdict.measures is None else vars(verdict.measures)
        finite = {name: value for name, value in measures.items() if math.isfinite(value)}
        shown = verdict.measures is not None and len(found) < MOST_THUMBNAILS
        picture = thumbnail(by_name[verdict.name], THUMBNAIL_PX) if shown else None
        found.append(UnusedPhotograph(verdict.name, "quality", str(verdict.left_out), finite, picture))
    return found


def _unregistered(prepared: Prepared, scene: Path) -> list[UnusedPhotograph]:
    """List photographs that are not in the model, with the likely reason: how well they match any other."""
    unregistered = prepared.used - set(prepared.models[0])
    if not unregistered:
        return []
    elsewhere = {name: model for model in prepared.models[1:] for name in model}
    matches: dict[str, list[int]] = {}  # verified ones, with each photograph that it matches
    with pycolmap.Database.open(scene / "prepare" / "database.db") as db:
        names = {image.image_id: decode_name(image.name) for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(number) for number, name in names.items()}
        for pair, inliers in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if inliers:
                for number in pycolmap.pair_id_to_image_pair(pair):
                    matches.setdefault(names[number], []).append(int(inliers))
    found = []
    for photograph in prepared.survey.photographs:
        name = photograph.name
        if name in unregistered:
            reason = _why(features[name], matches.get(name, []), elsewhere.get(name))
            picture = thumbnail(photograph, THUMBNAIL_PX) if len(found) < MOST_THUMBNAILS else None
            found.append(UnusedPhotograph(name, "poses", reason, {}, picture))
    return found


def _why(features: int, matches: list[int], model: list[str] | None) -> str:
    """Say why a photograph was not registered; `model` lists the photographs of another model that has it."""
    if model:
        where = f"{model[0]} to {model[-1]}"
        return f"matches only {len(model) - 1} others, of a place that nothing connects with the rest ({where})"
    if features < FEW_FEATURES:
        return f"only {features} features were found: the ground has too little texture, or the photograph is blurred"
    if not matches:
        return f"none of its {features} features match another photograph: expected overlap with at least two others"
    return (
        f"matches {len(matches)} other{'s' * (len(matches) > 1)}, by {max(matches)} features at most: too few, or "
        "too close to one line, to estimate its pose; fly with more overlap here"
    )


def _examples(
    prepared: Prepared, scene: Path, correction: ExposureCorrection
) -> tuple[tuple[str, Picture, Picture], ...]:
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    names = sorted(prepared.models[0])
    shown = []
    for k in np.argsort(-np.abs(np.log(correction.gain)).mean(1))[:EXAMPLES]:
        before = by_name[names[k]]
        after = replace(before, path=scene / "images" / names[k], orientation=1)
        shown.append((names[k], thumbnail(before, EXAMPLE_PX), thumbnail(after, EXAMPLE_PX)))
    return tuple(shown)
