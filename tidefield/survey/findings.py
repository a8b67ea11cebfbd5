"""Collect the findings of a preparation for its report."""

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
from tidefield.survey import report
from tidefield.survey.colour import ExposureCorrection
from tidefield.survey.io.image_decoding import thumbnail
from tidefield.survey.prepare import Prepared
from tidefield.survey.report.page import MOST_THUMBNAILS
from tidefield.survey.sfm.features import decode_name
from tidefield.survey.sfm.mapping import lens_notes
from tidefield.survey.survey import Photograph

THUMBNAIL_PX = 200
EXAMPLES = 3
"""Photographs that are shown before and after the colour correction."""


def findings(prepared: Prepared, scene: Path, options: Mapping[str, str]) -> report.Findings:
    """Collect everything that the report of a prepared scene describes."""
    located = prepared.georeference
    return report.Findings(
        title=prepared.survey.folder.resolve().name,
        date=datetime.now(UTC),
        survey=prepared.survey,
        reconstruction=pycolmap.Reconstruction(scene / "sparse" / "0"),
        georeference=located,
        left_out=(*_rejected(prepared), *_unregistered(prepared, scene)),
        models=tuple(len(names) for names in prepared.models),
        colour=_colour(prepared, scene),
        seconds=prepared.seconds,
        options=dict(options),
        versions={
            "tidefield": __version__,
            "pycolmap": pycolmap.__version__,
            "Python": platform.python_version(),
        },
        remarks=(*located.notes, *lens_notes(prepared.lens), *prepared.survey.remarks),
    )


def _rejected(prepared: Prepared) -> list[report.UnusedPhotograph]:
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    rejected = [verdict for verdict in prepared.verdicts if verdict.left_out and verdict.name not in prepared.used]
    found = []
    for verdict in rejected:
        measures = {} if verdict.measures is None else vars(verdict.measures)
        finite = {name: value for name, value in measures.items() if math.isfinite(value)}
        shown = verdict.measures is not None and len(found) < MOST_THUMBNAILS
        picture = thumbnail(by_name[verdict.name], THUMBNAIL_PX) if shown else None
        found.append(report.UnusedPhotograph(verdict.name, "quality", str(verdict.left_out), finite, picture))
    return found


def _unregistered(prepared: Prepared, scene: Path) -> list[report.UnusedPhotograph]:
    """List photographs that are not in the model, with the likely reason: how well they match any other."""
    unregistered = prepared.used - set(prepared.models[0])
    used = [photograph for photograph in prepared.survey.photographs if photograph.name in unregistered]
    if not used:
        return []
    elsewhere = {name: model for model in prepared.models[1:] for name in model}
    features, matches = _counts(scene / "prepare" / "database.db")
    found = []
    for photograph in used:
        reason = _why(photograph, features[photograph.name], matches.get(photograph.name, []), elsewhere)
        picture = thumbnail(photograph, THUMBNAIL_PX) if len(found) < MOST_THUMBNAILS else None
        found.append(report.UnusedPhotograph(photograph.name, "poses", reason, {}, picture))
    return found


def _why(photograph: Photograph, features: int, matches: list[int], elsewhere: dict[str, list[str]]) -> str:
    if photograph.name in elsewhere:
        names = elsewhere[photograph.name]
        where = f"{names[0]} to {names[-1]}"
        return f"matches only {len(names) - 1} others, of a place that nothing connects with the rest ({where})"
    if features < 500:
        return f"only {features} features were found: the ground has too little texture, or the photograph is blurred"
    if not matches:
        return f"none of its {features} features match another photograph: expected overlap with at least two others"
    return (
        f"matches {len(matches)} other{'s' * (len(matches) > 1)}, by {max(matches)} features at most: too few, or "
        "too close to one line, to estimate its pose; fly with more overlap here"
    )


def _counts(database: Path) -> tuple[dict[str, int], dict[str, list[int]]]:
    """Count the features of every photograph, and its verified matches with each photograph that it matches."""
    matches: dict[str, list[int]] = {}
    with pycolmap.Database.open(database) as db:
        names = {image.image_id: decode_name(image.name) for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(number) for number, name in names.items()}
        for pair, inliers in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if inliers:
                for number in pycolmap.pair_id_to_image_pair(pair):
                    matches.setdefault(names[number], []).append(int(inliers))
    return features, matches


def _colour(prepared: Prepared, scene: Path) -> report.ColourCorrection | None:
    correction = prepared.correction
    if correction is None or math.isnan(correction.before):
        return None
    unit = "% of a pixel's value"
    changes = [
        report.Change(
            "difference between photographs at points that took no part in the estimate",
            100 * correction.before,
            100 * min(correction.gains_alone, correction.after),
            unit,
        )
    ]
    vignetting = " and the vignetting of the lens was removed" if correction.sees_falloff else ""
    verdict = (
        f"Exposure and white balance were corrected{vignetting}; the brightest photograph had "
        f"{correction.gain.max() / correction.gain.min():.1f} times the gain of the darkest."
        if correction.helps
        else "The photographs agree as they are: their colours were not changed."
    )
    return report.ColourCorrection(correction.helps, verdict, tuple(changes), _examples(prepared, scene, correction))


def _examples(prepared: Prepared, scene: Path, correction: ExposureCorrection) -> tuple[report.ColourExample, ...]:
    if not correction.helps:
        return ()
    by_name = {photograph.name: photograph for photograph in prepared.survey.photographs}
    names = sorted(prepared.models[0])
    change = np.abs(np.log(correction.gain)).mean(1)
    shown = []
    for k in np.argsort(-change)[:EXAMPLES]:
        before = by_name[names[k]]
        after = replace(before, path=scene / "images" / names[k], orientation=1)
        shown.append(report.ColourExample(names[k], *(thumbnail(p, THUMBNAIL_PX) for p in (before, after))))
    return tuple(shown)
