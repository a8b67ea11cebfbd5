"""`tidefield prepare`: from a folder of photographs to a scene."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Downscale, Verbosity
from tidefield.errors import RunError
from tidefield.files import writing_to

if TYPE_CHECKING:
    from rich.console import Console

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prepare:
    """Make a scene of a folder of drone photographs: quality, poses, georeference, colours and a report.

    The scene has a COLMAP model and a transforms.json: COLMAP, nerfstudio, gsplat and OpenSplat open it, too. Ctrl-C
    loses at most the running stage; the same command continues, and a changed option redoes only what depends on it.
    """

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder with the photographs (JPEG, PNG, TIFF, HEIC), in sub-folders too."""
    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder for the scene: a new one, or one to continue."""
    gps: Path | None = None
    """Positions of the photographs (gps.csv or ODM's geo.txt), instead of EXIF's; without it, such a file next to the
    photographs is used where EXIF has none."""
    control: Path | None = None
    """Ground control (ODM's gcp_list.txt); without it, such a file next to the photographs is used."""
    masks: Path | None = None
    """Folder with a mask of each photograph, such as IMG_1.jpg.png for IMG_1.jpg, black where it is not to be used;
    without it, a folder `masks` next to the photographs is used."""
    no_control: Annotated[bool, arg(name="no-control", help="Use no ground control, even if a file is there.")] = False
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    """Lens of the camera. What a fisheye sees beyond 120 degrees is left out when the scene is read."""
    keep_all: bool = False
    """Use photographs of low quality, too."""
    holdout: bool = False
    """Keep every eighth photograph out of poses, points and colours, and place it afterwards: for figures that owe
    nothing to what is held out. Make maps and other products without it."""
    colour: Literal["auto", "on", "off"] = "auto"
    """Correct exposures: where it helps, always, or never. The lens' falloff is corrected with them, where it helps."""
    features: int = 6000
    """Most features to find in a photograph: 100 to 50000."""
    feature_width: int = 2400
    """Longer side in pixels to which larger photographs are reduced to find features: 100 to 50000."""
    mapper: Literal["incremental", "global"] = "incremental"
    """How poses are estimated: photograph by photograph, or all at once. Surveys of more than 400 photographs are
    reconstructed in blocks that share photographs, by either."""
    downscale: Downscale = ()
    redo: str | None = None
    """Name of a stage to repeat, with all that follow: quality, features, ..., images, as the messages name them."""
    device: Annotated[str, arg(help="auto, cpu or cuda: where features are found and matched.")] = "auto"
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def prepare(options: Prepare, console: Console) -> None:
    """Run `tidefield prepare`."""
    from tidefield.survey.io.photographs import read_survey
    from tidefield.survey.prepare import prepare as prepare_scene
    from tidefield.survey.report import collect_findings, write_report
    from tidefield.survey.sfm.features import FeatureOptions, choose_device, set_up_pycolmap

    if options.control is not None and options.no_control:
        raise RunError("both --control and --no-control are given: expected one of them; leave one out")
    set_up_pycolmap(options.verbosity.verbose)
    features, device = FeatureOptions(options.feature_width, options.features), choose_device(options.device)
    survey = read_survey(
        options.photographs,
        options.gps,
        options.control,
        find_control=not options.no_control,
        masks=options.masks,
    )
    for remark in survey.remarks:
        log.warning(remark)
    prepared = prepare_scene(
        survey,
        options.scene,
        features,
        device,
        console,
        lens=options.lens,
        keep_all=options.keep_all,
        holdout=options.holdout,
        colour=options.colour,
        downscale=options.downscale,
        mapper=options.mapper,
        redo=options.redo,
    )
    with writing_to(options.scene):
        page = write_report(collect_findings(prepared, options.scene, _shown(options)), options.scene)
    located = prepared.georeference
    if located.frame is None:
        log.warning(located.notes[0])
    points, marks = (sum(item.kind == kind for item in located.left_out) for kind in ("control point", "mark"))
    if points or marks:
        found = [f"{n} {what}{'s'[: n > 1]}" for n, what in ((points, "point"), (marks, "single mark")) if n]
        log.warning(f"ground control: {' and '.join(found)} left out; why, is in {page}")
    missing = len(survey.photographs) - len(prepared.models[0])
    reasons = (
        f"; why {missing} {'is' if missing == 1 else 'are'} missing, and more, is in {page}"
        if missing
        else f"; see {page}"
    )
    console.print(
        f"{options.scene}: {len(prepared.models[0])} of {len(survey.photographs)} photographs{reasons}",
        highlight=False,
        soft_wrap=True,
    )


def _shown(options: Prepare) -> dict[str, str]:
    """The options that the report shows: those that are on, and of paths their names, as a report is sent on."""
    given = {name: value for name, value in vars(options).items() if name not in ("scene", "verbosity", "redo")}
    return {
        name.replace("_", " "): "yes"
        if value is True
        else value.resolve().name
        if isinstance(value, Path)
        else " ".join(map(str, value))
        if isinstance(value, tuple)
        else str(value)
        for name, value in given.items()
        if value is not None and value is not False and value != ()
    }
