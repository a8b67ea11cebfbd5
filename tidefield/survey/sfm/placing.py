"""Place photographs in a finished model that took no part in it: its points and lenses are held.

Each pose is estimated from the photograph's matches with points of the model, by RANSAC and then by robust least
squares of the reprojection errors. The photographs get no observations, so the model's points remain as they are.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.survey.sfm.features import decode_name
from tidefield.survey.survey import Progress

MIN_INLIERS = 30
"""Matches that a pose must fit: COLMAP's value for mapping."""


def place(model: pycolmap.Reconstruction, database: Path, names: Collection[str], progress: Progress) -> dict[str, int]:
    """Add photographs to a model, in place, without changing anything else of it.

    Args:
        database: with the photographs' features, and their matches with photographs of the model.

    Returns:
        For each photograph that cannot be placed, the number of matches that fit its best pose.
    """
    options = pycolmap.AbsolutePoseEstimationOptions()
    # A fixed seed, so that the same photographs give the same poses.
    options.ransac.random_seed = 0
    registered, failed = sorted(model.reg_image_ids()), {}
    with pycolmap.Database.open(database) as db:
        images = sorted((decode_name(image.name), image) for image in db.read_all_images())
        images = [(name, image) for name, image in images if name in names]
        for done, (name, image) in enumerate(images, start=1):
            uv, xyz = _matched_points(model, db, image.image_id, registered)
            found = None
            if image.camera_id in model.cameras and len(uv):
                camera = model.cameras[image.camera_id]
                found = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, camera, options)
            inliers = 0 if found is None else int(found["num_inliers"])
            if found is None or inliers < MIN_INLIERS:
                failed[name] = inliers
            else:
                new = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
                model.add_image_with_trivial_frame(new, found["cam_from_world"])
            progress(done, len(images))
    return failed


def _matched_points(
    model: pycolmap.Reconstruction, db: pycolmap.Database, number: int, registered: Collection[int]
) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, "M 3"]]:
    """Pixels of a photograph, and the points of the model whose observations match its features there."""
    matched = set()
    for other in registered:
        if db.exists_two_view_geometry(number, other):
            seen = model.image(other).points2D
            for own, theirs in db.read_two_view_geometry(number, other).inlier_matches.tolist():
                if seen[theirs].has_point3D():
                    matched.add((own, seen[theirs].point3D_id))
    keypoints = np.asarray(db.read_keypoints(number), dtype=np.float64)
    pairs = sorted(matched)
    uv = np.array([keypoints[own, :2] for own, _ in pairs]).reshape(-1, 2)
    return uv, np.array([model.points3D[point].xyz for _, point in pairs]).reshape(-1, 3)
