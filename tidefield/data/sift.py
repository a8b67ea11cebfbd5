"""SIFT features of a picture, by pycolmap (VLFeat, or its own CUDA implementation)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, UInt8

if TYPE_CHECKING:
    import pycolmap

MAX_RATIO, MAX_ANGLE_RAD = 0.8, 0.7
"""Limits on the angle between matching descriptors, relative to the second nearest and absolute: COLMAP's values."""
MOST_EXTRA = 4
"""Times the number of features that is asked for at most, where much is masked."""


def find_features(
    grey: UInt8[np.ndarray, "H W"], count: int, device: pycolmap.Device, used: Bool[np.ndarray, "_ _"] | None = None
) -> tuple[Float32[np.ndarray, "K 4"], UInt8[np.ndarray, "K 128"]]:
    """Extract keypoints (u, v, scale, orientation; pixels) and RootSIFT descriptors, the largest first.

    Args:
        grey: the picture; it is not enlarged first, which finds little more in sharp photographs.
        count: the largest number of features, of which the largest are kept: they are the most repeatable.
        used: where features may lie, a mask of the same aspect and any size; everywhere if not given.
    """
    import pycolmap

    sift = pycolmap.FeatureExtractionOptions()
    sift.num_threads = 1
    share = 1.0 if used is None else float(used.mean())
    sift.sift.max_num_features = math.ceil(count / max(share, 1 / MOST_EXTRA))  # masked ones are found, too
    sift.sift.first_octave = 0
    found, descriptors = pycolmap.FeatureExtractor.create(sift, device=device).extract_from_uint8_array(grey)
    keypoints = np.asarray(pycolmap.keypoints_to_matrix(found), dtype=np.float32)[:, :4]
    order = np.argsort(-keypoints[:, 2], kind="stable")
    if used is not None:
        height, width = used.shape
        pixel = keypoints[order, :2] * (width / grey.shape[1], height / grey.shape[0])
        column, row = np.floor(pixel).astype(np.int64).T
        order = order[used[row.clip(0, height - 1), column.clip(0, width - 1)]]
    largest = order[:count]  # VLFeat returns somewhat more than the maximum
    return keypoints[largest], np.asarray(descriptors.data, dtype=np.uint8)[largest]
