"""What a preparation found, as the report tells it."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pycolmap

from tidefield import __version__
from tidefield.data.georeference import Georeference
from tidefield.survey import report
from tidefield.survey.colour import Evening
from tidefield.survey.georeference.gps_alignment import camera_centres
from tidefield.survey.io.pictures import thumbnail
from tidefield.survey.prepare import Prepared
from tidefield.survey.report.page import MOST_THUMBNAILS
from tidefield.survey.sfm.features import opened, real_name
from tidefield.survey.sfm.lens_choice import told
from tidefield.survey.survey import Photograph

THUMBNAIL_PX = 200
EXAMPLES = 3
"""Photographs that are shown before and after colour evening."""


def findings(prepared: Prepared, scene: Path, options: Mapping[str, str]) -> report.Findings:
    """Everything that the report of a prepared scene tells."""
    model, located = pycolmap.Reconstruction(scene / "sparse" / "0"), prepared.georeference
    return report.Findings(
        title=prepared.survey.folder.resolve().name,
        date=datetime.now(UTC),
        survey=prepared.survey,
        reconstruction=model,
        frame=located.frame,
        placed_by=_placed_by(located),
        residuals=_residuals(model, prepared),
        left_out=(*_unfit(prepared), *_unplaced(prepared, scene)),
        models=tuple(len(names) for names in prepared.models),
        colour=_colour(prepared, scene),
        seconds=prepared.seconds,
        options=dict(options),
        versions={
            "tidefield": __version__,
            "pycolmap": pycolmap.__version__,
            "Python": platform.python_version(),
        },
        remarks=(*located.notes, *told(prepared.lens), *prepared.survey.remarks),
    )


def _placed_by(located: Georeference) -> str:
    gps = f"GPS of {len(located.gps_used.names)} photographs"
    if located.source == "ground control":
        return f"{len(located.control.names)} control points" + (f", {gps}" if located.gps_used.names else "")
    return gps if located.source == "GPS" else ""


def _residuals(model: pycolmap.Reconstruction, prepared: Prepared) -> tuple[report.Residuals, ...]:
    located, centres = prepared.georeference, camera_centres(model)
    wrong = {item.name for item in located.left_out if item.kind == "GPS"}
    used = np.array([name not in wrong for name in located.gps.names], dtype=bool)
    there = np.array([centres[name] for name in located.gps.names]).reshape(-1, 3)
    reasons = tuple(f"{item.name}: {item.reason}" for item in located.left_out if item.kind == "GPS")
    found = [
        report.Residuals(
            "gps",
            "GPS of the cameras",
            located.gps.names,
            located.gps.error_m,
            there - located.gps.error_m,
            used,
            reasons,
        )
    ]
    control = prepared.survey.control
    if located.source == "ground control" and control is not None and located.frame is not None:
        marks = tuple(f"{item.name}: {item.reason}" for item in located.left_out if item.kind != "GPS")
        kinds: tuple[tuple, ...] = (
            ("control", "Control points", located.control, marks),
            ("check", "Control points, each left out in turn", located.check, ()),
        )
        for kind, title, errors, told in kinds:
            stated = located.frame.from_crs(np.array([control.points[n] for n in errors.names]).reshape(-1, 3))
            known = np.asarray(np.isfinite(errors.error_m).all(axis=1))
            found.append(report.Residuals(kind, title, errors.names, errors.error_m, stated, known, told))
    return tuple(item for item in found if item.names)


def _unfit(prepared: Prepared) -> list[report.LeftOut]:
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    unfit = [verdict for verdict in prepared.verdicts if verdict.left_out and verdict.name not in prepared.used]
    told = []
    for verdict in unfit:
        measures = {} if verdict.measures is None else vars(verdict.measures)
        finite = {name: value for name, value in measures.items() if math.isfinite(value)}
        shown = verdict.measures is not None and len(told) < MOST_THUMBNAILS
        picture = thumbnail(by_name[verdict.name], THUMBNAIL_PX) if shown else None
        told.append(report.LeftOut(verdict.name, "quality", str(verdict.left_out), finite, picture))
    return told


def _unplaced(prepared: Prepared, scene: Path) -> list[report.LeftOut]:
    """Photographs that are not in the model, with the likely reason: how well they match any other."""
    unplaced = prepared.used - set(prepared.models[0])
    used = [photograph for photograph in prepared.survey.photographs if photograph.name in unplaced]
    if not used:
        return []
    elsewhere = {name: model for model in prepared.models[1:] for name in model}
    features, matches = _counts(scene / "prepare" / "database.db")
    told = []
    for photograph in used:
        reason = _why(photograph, features[photograph.name], matches.get(photograph.name, []), elsewhere)
        picture = thumbnail(photograph, THUMBNAIL_PX) if len(told) < MOST_THUMBNAILS else None
        told.append(report.LeftOut(photograph.name, "poses", reason, {}, picture))
    return told


def _why(photograph: Photograph, features: int, matches: list[int], elsewhere: dict[str, list[str]]) -> str:
    if photograph.name in elsewhere:
        place = elsewhere[photograph.name]
        where = f"{place[0]} to {place[-1]}"
        return f"fits only {len(place) - 1} others, of a place that nothing connects with the rest ({where})"
    if features < 500:
        return f"only {features} features were found: the ground shows too little, or the photograph is blurred"
    if not matches:
        return (
            f"none of its {features} features agree with another photograph: expected overlap with at least two others"
        )
    return (
        f"agrees with {len(matches)} other{'s' * (len(matches) > 1)}, by {max(matches)} features at most: too few, or "
        "too much on one line, to place it; fly with more overlap here"
    )


def _counts(database: Path) -> tuple[dict[str, int], dict[str, list[int]]]:
    """Features of every photograph, and how many agree with each other photograph that any agree with."""
    matches: dict[str, list[int]] = {}
    with opened(database) as db:
        names = {image.image_id: real_name(image.name) for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(number) for number, name in names.items()}
        for pair, inliers in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if inliers:
                for number in pycolmap.pair_id_to_image_pair(pair):
                    matches.setdefault(names[number], []).append(int(inliers))
    return features, matches


def _colour(prepared: Prepared, scene: Path) -> report.ColourEvening | None:
    evening = prepared.evening
    if evening is None or math.isnan(evening.before):
        return None
    unit = "% of a pixel's value"
    changes = [
        report.Change(
            "how much photographs disagree about points that took no part in the estimate",
            100 * evening.before,
            100 * min(evening.gains_alone, evening.after),
            unit,
        )
    ]
    falloff = " and the lens' falloff towards the corners was removed" if evening.sees_falloff else ""
    verdict = (
        f"Exposure and white balance were evened out{falloff}; the brightest photograph had "
        f"{evening.gain.max() / evening.gain.min():.1f} times the gain of the darkest."
        if evening.helps
        else "The photographs agree as well as they are: their colours were left alone."
    )
    return report.ColourEvening(evening.helps, verdict, tuple(changes), _examples(prepared, scene, evening))


def _examples(prepared: Prepared, scene: Path, evening: Evening) -> tuple[report.ColourExample, ...]:
    if not evening.helps:
        return ()
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    names = sorted(prepared.models[0])
    change = np.abs(np.log(evening.gain)).mean(1)
    shown = []
    for k in np.argsort(-change)[:EXAMPLES]:
        before = by_name[names[k]]
        after = replace(before, path=scene / "images" / names[k], orientation=1)
        shown.append(report.ColourExample(names[k], *(thumbnail(p, THUMBNAIL_PX) for p in (before, after))))
    return tuple(shown)
