"""Pairs of photographs are matched and verified once."""

from pathlib import Path

import numpy as np
import pycolmap

from tidefield.survey.sfm.features import opened
from tidefield.survey.sfm.matching import match


def test_pairs_are_matched_verified_and_kept(tmp_path: Path):
    """Features whose descriptors are their points' own: all matches are right, so the geometry must agree."""
    path, rng = tmp_path / "database.db", np.random.default_rng(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=200
    )
    with opened(path) as db:
        model = pycolmap.synthesize_dataset(options, db)
        descriptors = {number: rng.integers(0, 255, (128,)) for number in model.point3D_ids()}
        db.clear_matches()
        db.clear_two_view_geometries()
        db.clear_descriptors()
        for image in db.read_all_images():
            points = model.image(image.image_id).points2D
            table = np.stack([descriptors.get(p.point3D_id, rng.integers(0, 255, (128,))) for p in points]).astype(
                np.uint8
            )
            described = pycolmap.FeatureDescriptors(data=table, type=pycolmap.FeatureExtractorType.SIFT)
            db.write_descriptors(image.image_id, described)
        names = sorted(image.name for image in db.read_all_images())
    pairs, calls = [(names[0], names[1]), (names[1], names[2])], []
    agree, inliers = match(path, pairs, pycolmap.Device.cpu, lambda done, whole: calls.append((done, whole)))
    assert agree == 2
    assert inliers > 200
    assert calls[-1] == (2, 2)
    again = match(
        path, [*pairs, (names[0], names[3])], pycolmap.Device.cpu, lambda done, whole: calls.append((done, whole))
    )
    assert again[0] == 3
    assert calls[-1] == (3, 3)
    with opened(path) as db:
        assert len(db.read_all_matches()[0]) == 3
