"""Camera poses, lenses and sparse points from matches: structure from motion by pycolmap.

Flat ground photographed straight down does not tell the focal length: a longer one with a higher flight explains the
matches as well (and bent ground, any error of the distortion). So while the model grows, focal lengths are held to what
is known beforehand.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from tidefield.errors import SurveyError
from tidefield.survey.sfm.features import opened, real_name
from tidefield.survey.stages import interruptible

log = logging.getLogger(__name__)

FEWEST = 3
"""Photographs of the smallest model."""


@dataclass(frozen=True)
class Models:
    """What structure from motion found.

    Attributes:
        best: the model with the most photographs; its image names are the photographs'.
        others: names of the photographs of the other models, the larger first: places that nothing connects.
    """

    best: pycolmap.Reconstruction
    others: tuple[tuple[str, ...], ...]


def reconstruct(database: Path, folder: Path, progress: Callable[[int, int], object]) -> Models:
    """Grow models from the matches in a database.

    Args:
        folder: where pycolmap may write; made if it is not there.

    Raises:
        SurveyError: no three photographs fit together.
    """
    with opened(database) as db:
        count = db.num_images()
        known = all(camera.has_prior_focal_length for camera in db.read_all_cameras())
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.extract_colors, options.random_seed = FEWEST, False, 0
    options.ba_refine_focal_length = not known
    options.mapper.abs_pose_refine_focal_length = not known
    registered = 0

    def one_more() -> None:
        nonlocal registered
        registered += 1
        progress(min(registered, count), count)

    folder.mkdir(parents=True, exist_ok=True)
    found = interruptible(
        lambda token: pycolmap.incremental_mapping(
            database, folder, folder, options, next_image_callback=one_more, cancellation_token=token
        )
    )
    for model in found.values():
        for image in model.images.values():
            image.name = real_name(image.name)
    models = sorted(found.values(), key=lambda model: -model.num_reg_images())
    if not models:
        raise SurveyError(
            f"none of the {count} photographs could be placed: expected photographs that overlap by half or more and "
            "show ground with some texture; fly with more overlap, or add the photographs in between"
        )
    return Models(models[0], tuple(tuple(registered_names(model)) for model in models[1:]))


def registered_names(model: pycolmap.Reconstruction) -> list[str]:
    return sorted(model.image(number).name for number in model.reg_image_ids())
