"""Matches are mutual and stand out; the geometry that they agree on is kept once."""

from pathlib import Path

import numpy as np
import pycolmap
import torch
from torch import Tensor

from tidefield.ingest.motion.features import opened
from tidefield.ingest.motion.matching import FARTHEST_RAD, RATIO, match, matched


def unit(count: int, seed: int) -> Tensor:
    values = torch.rand(count, 128, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(values**4, dim=1)


def brute_force(ours: Tensor, theirs: Tensor) -> list[int]:
    angle = (ours @ theirs.T).clamp(-1, 1).acos()
    result = []
    for i, row in enumerate(angle):
        first, second = row.sort().values[:2].tolist()
        j = int(row.argmin())
        stands_out = first < RATIO * second and first < FARTHEST_RAD
        result.append(j if stands_out and int(angle[:, j].argmin()) == i else -1)
    return result


def test_matching_is_what_brute_force_finds():
    ours, strangers = unit(60, 0), unit(30, 1)
    noisy = torch.nn.functional.normalize(ours[10:50] + 0.03 * unit(40, 2), dim=1)
    theirs = torch.cat([strangers, noisy, ours[:1], ours[:1]])  # the last two are alike: nothing stands out
    found = matched(ours, theirs)
    assert found.tolist() == brute_force(ours, theirs)
    assert found[0] == -1
    assert (found[10:50] == torch.arange(30, 70)).float().mean() > 0.9


def test_batches_of_pairs_match_as_single_pairs_do():
    first, second = torch.stack([unit(20, 0), unit(20, 1)]), torch.stack([unit(25, 0), unit(25, 1)])
    together = matched(first, second)
    assert torch.equal(together, torch.stack([matched(a, b) for a, b in zip(first, second, strict=True)]))


def test_zeros_match_nothing():
    assert (matched(torch.zeros(4, 128), unit(6, 0)) == -1).all()


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
    agree, inliers = match(path, pairs, torch.device("cpu"), lambda done, whole: calls.append((done, whole)))
    assert agree == 2
    assert inliers > 200
    assert calls[-1] == (2, 2)
    again = match(
        path, [*pairs, (names[0], names[3])], torch.device("cpu"), lambda done, whole: calls.append((done, whole))
    )
    assert again[0] == 3
    assert calls[-1] == (3, 3)
    with opened(path) as db:
        assert len(db.read_all_matches()[0]) == 3
