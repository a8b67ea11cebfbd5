"""`tidefield prepare` and `tidefield import`: photographs and projects become scenes."""

from __future__ import annotations

import logging
from dataclasses import replace

import pycolmap
from rich.console import Console

from tidefield.errors import RunError
from tidefield.options import Import, Prepare
from tidefield.progress import ProgressBar
from tidefield.survey import import_project as convert
from tidefield.survey.findings import findings
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.prepare import PrepareOptions
from tidefield.survey.prepare import prepare as prepare_scene
from tidefield.survey.report import write_report
from tidefield.survey.sfm.features import FeatureOptions
from tidefield.survey.sfm.features import choose_device as choose_pycolmap_device

log = logging.getLogger(__name__)


def prepare(options: Prepare, console: Console) -> None:
    """See `tidefield prepare --help`."""
    if options.control is not None and options.no_control:
        raise RunError("both --control and --no-control are given: expected one of them; leave one out")
    survey = read_survey(options.photographs, options.gps, options.control)
    # Its log tells every step of structure from motion.
    pycolmap.logging.minloglevel = int(pycolmap.logging.INFO if options.verbosity.verbose else pycolmap.logging.ERROR)
    if options.no_control:
        survey = replace(survey, control=None)
    for remark in survey.remarks:
        log.warning(remark)
    wishes = PrepareOptions(
        keep_all=options.keep_all,
        colour=options.colour,
        features=FeatureOptions(options.feature_width, options.features),
        redo=options.redo,
    )
    prepared = prepare_scene(survey, options.scene, wishes, choose_pycolmap_device(options.device), console)
    asked = {name: str(value) for name, value in vars(options).items() if name not in ("scene", "verbosity", "redo")}
    report = write_report(findings(prepared, options.scene, asked), options.scene)
    lost = len(survey.photographs) - len(prepared.models[0])
    console.print(
        f"{options.scene}: {len(prepared.models[0])} of {len(survey.photographs)} photographs"
        + (
            f"; why {lost} are missing, and more, stands in {report.page}"
            if lost
            else f"; more stands in {report.page}"
        ),
        highlight=False,
        soft_wrap=True,
    )


def import_project(options: Import, console: Console) -> None:
    """See `tidefield import --help`."""
    with ProgressBar(console, "Placing photographs") as meter:
        made = convert.import_project(
            options.project, options.scene, link=options.link, allow_missing=options.allow_missing, progress=meter
        )
    seen = f", seen {made.observations:,} times" if made.observations else ""
    frame = made.georeference and made.georeference.frame
    where = f"; in metres about {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f} ({frame.crs})" if frame else ""
    console.print(
        f"{options.scene}: {made.photographs} photographs, {made.held_out} of them held out; {made.cameras} "
        f"camera{'s' * (made.cameras > 1)}; {made.points:,} sparse points{seen}{where}",
        highlight=False,
        soft_wrap=True,
    )
