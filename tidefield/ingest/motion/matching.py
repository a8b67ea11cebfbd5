"""Matches between photographs, and the two-view geometry that they agree on.

Matching is exhaustive over descriptors: nearest neighbours both ways with Lowe's ratio test, as matrix products, which
CPUs and GPUs alike are good at. The geometry is pycolmap's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from tidefield.ingest.motion.features import opened

RATIO, FARTHEST_RAD = 0.8, 0.7
"""A match is nearer than `RATIO` times the second nearest and than `FARTHEST_RAD`, as angles: COLMAP's values."""
AT_ONCE = 16
"""Pairs that are matched before their geometry is estimated, side by side."""
REMEMBERED = 128
"""Photographs whose descriptors stay in memory."""


def matched(
    ours: Float[Tensor, "... K D"], theirs: Float[Tensor, "... L D"], ratio: float = RATIO
) -> Int[Tensor, "... K"]:
    """For each of our descriptors the index of its match among theirs, or -1.

    A match is a pair of mutual nearest neighbours that stands out from the second nearest.

    Args:
        ours, theirs: descriptors of unit length (zeros match nothing).
    """
    cosine = ours @ theirs.transpose(-1, -2)
    best, index = cosine.topk(min(2, theirs.shape[-2]), dim=-1)
    angle = best.float().clamp(-1, 1).acos()
    back = cosine.argmax(dim=-2)
    mutual = back.gather(-1, index[..., 0]) == torch.arange(ours.shape[-2], device=ours.device)
    good = mutual & (angle[..., 0] < ratio * angle[..., -1]) & (angle[..., 0] < FARTHEST_RAD)
    return torch.where(good, index[..., 0], -1)


def match(
    database: Path, pairs: Sequence[tuple[str, str]], device: torch.device, progress: Callable[[int, int], object]
) -> tuple[int, int]:
    """Match pairs of photographs by name and write what agrees to the database; what it holds already is kept.

    Returns:
        How many pairs agree on a geometry, and how many matches support these in all.
    """
    with opened(database) as db:
        images = {image.name: image for image in db.read_all_images()}
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}

        @lru_cache(REMEMBERED)
        def features(name: str) -> tuple[NDArray[np.float64], Tensor]:
            number = images[name].image_id
            points = np.asarray(db.read_keypoints(number), dtype=np.float64)[:, :2]
            descriptors = torch.from_numpy(np.array(db.read_descriptors(number).data)).to(device)
            return points, torch.nn.functional.normalize(descriptors.float(), dim=1)

        def geometry(job: tuple[str, str, NDArray[np.uint32]]) -> pycolmap.TwoViewGeometry:
            first, second, matches = job
            cameras_ = [cameras[images[name].camera_id] for name in (first, second)]
            points = [features(name)[0] for name in (first, second)]
            return pycolmap.estimate_two_view_geometry(cameras_[0], points[0], cameras_[1], points[1], matches, options)

        options = pycolmap.TwoViewGeometryOptions()
        # The same photographs give the same poses.
        options.ransac.random_seed = 0
        todo = [pair for pair in pairs if not db.exists_two_view_geometry(*(images[name].image_id for name in pair))]
        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            for start in range(0, len(todo), AT_ONCE):
                jobs = []
                for first, second in todo[start : start + AT_ONCE]:
                    index = matched(features(first)[1], features(second)[1]).cpu().numpy()
                    ours = np.flatnonzero(index >= 0)
                    jobs.append((first, second, np.stack([ours, index[ours]], 1).astype(np.uint32)))
                found = list(pool.map(geometry, jobs))
                with pycolmap.DatabaseTransaction(db):
                    for (first, second, matches), two_view in zip(jobs, found, strict=True):
                        numbers = images[first].image_id, images[second].image_id
                        db.write_matches(*numbers, matches)
                        db.write_two_view_geometry(*numbers, two_view)
                progress(len(pairs) - len(todo) + min(start + AT_ONCE, len(todo)), len(pairs))
        _, inliers = db.read_two_view_geometry_num_inliers()
        return sum(n > 0 for n in inliers), sum(inliers)
