"""`tidefield import`: from a project of another program to a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Downscale, Verbosity

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Import:
    """Make a scene of a project of ODM or OpenSfM, of a COLMAP model, or of nerfstudio's transforms.json.

    Poses and photographs stay as they are; only photographs whose lens has k3 are undistorted, because other programs
    do not read it. The scene has a COLMAP model and a transforms.json: COLMAP, nerfstudio, gsplat and OpenSplat open
    it, too.
    """

    project: Annotated[Positional[Path], arg(metavar="PROJECT")]
    """Folder of the project or scene."""
    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder for the scene; must be new."""
    link: bool = False
    """Give the photographs a second name (hard links) instead of copying them."""
    undistort: bool = False
    """Undistort all photographs, for programs that open no others: the original 3D Gaussian splatting."""
    downscale: Downscale = ()
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def import_project(options: Import, console: Console) -> None:
    """Run `tidefield import`."""
    from tidefield.data.readers.files import read_json
    from tidefield.progress import ProgressBar
    from tidefield.survey import import_project as importing
    from tidefield.survey.sfm.features import set_up_pycolmap

    set_up_pycolmap(options.verbosity.verbose)
    with ProgressBar(console, "Copying photographs") as bar:
        model, located = importing.import_project(
            options.project,
            options.scene,
            link=options.link,
            undistort=options.undistort,
            downscale=options.downscale,
            allow_missing=options.allow_missing,
            progress=bar,
        )
    photographs, cameras, observations = model.num_images(), model.num_cameras(), model.compute_num_observations()
    observed = f", observed {observations:,} times" if observations else ""
    frame = located and located.frame
    held_out = len(read_json(options.scene / "transforms.json")["test_filenames"])
    where = f"; in metres about {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f} ({frame.crs})" if frame else ""
    console.print(
        f"{options.scene}: {photographs} photographs, {held_out} of them held out; {cameras} "
        f"camera{'s' * (cameras > 1)}; {model.num_points3D():,} sparse points{observed}{where}",
        highlight=False,
        soft_wrap=True,
    )
