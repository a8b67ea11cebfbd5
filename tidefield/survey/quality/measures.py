"""Measure the quality of one photograph, on a reduced image.

Sharpness comes from the structure function S(k), the mean squared difference of brightness between pixels k apart. On
natural ground it grows as k^0.5 to k^1; below the width of a blur it grows as k^2. So S(1) / S(8) falls from about 0.3
to under 0.1 with a blur of six pixels, at any contrast. Noise adds the same to both and is subtracted. Motion blurs
along one direction only, so the minimum of four directions counts. Smooth mud has few sharp blocks but some, a blurred
photograph none, so the sharpest tenth of the blocks counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import EllipsisType

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

SIDE_PX = 1600
"""Longer side of the image that is measured; blur that is invisible at this size does not harm a scene."""
THUMBNAIL_PX = 160
"""Longer side of the thumbnail by which photographs are compared."""

_NEAR, _FAR = 1, 8  # the two distances k
_BLOCK = 48
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_TEXTURED = 4.0  # least S(8) of a block with texture, in levels squared
_ABOVE_NOISE = 20.0  # and in variances of the noise
_MIN_TEXTURED = 0.02  # least share of such blocks; with fewer, sharpness is unknown
_SHARPEST = 90  # percentile over blocks
# Immerkaer, Fast Noise Variance Estimation, 1996: zero on planes and straight edges.
_NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_CLIPPED = 253
_SKY_LEVELS = 3.5  # largest local standard deviation of sky
_SKY_COLUMNS = 0.9  # least share of the columns that begin with sky
_SKY_RAGGED = 0.1  # largest deviation of its lower edge from a line, in heights


@dataclass(frozen=True)
class Measures:
    """Quality measures of one photograph, in 8-bit levels unless stated otherwise.

    Attributes:
        sharpness: S(1) / S(8), see above; NaN where there is too little texture.
        brightness: median.
        highlights: 95th percentile of brightness.
        light: median in linear light, 1 is white.
        clipped: share of pixels with at least one channel at its maximum.
        white: share of pixels with at least two channels at their maximum, which have no detail.
        contrast: between the 1st and the 99th percentile of the thumbnail, in which noise averages out.
        sky: share of the image that is a smooth bright region along the whole upper edge; 0 if that is masked.
    """

    sharpness: float
    brightness: float
    highlights: float
    light: float
    clipped: float
    white: float
    contrast: float
    sky: float


def measure(
    pixels: UInt8[np.ndarray, "H W 3"], used: Bool[np.ndarray, "_ _"] | None = None
) -> tuple[Measures, Float32[np.ndarray, "h w"]]:
    """Measure an upright image of at most `SIDE_PX`; returns also its grey thumbnail of at most `THUMBNAIL_PX`.

    Args:
        used: where the photograph is used, at any size; exposure and contrast are those of these pixels, or of all if
            there are none. None is everywhere.
    """
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, THUMBNAIL_PX / max(grey.shape))
    size = max(16, round(grey.shape[1] * scale)), max(16, round(grey.shape[0] * scale))
    thumbnail = cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    here, there = (_inside(used, image.shape) for image in (grey, thumbnail))
    low, high = np.percentile(thumbnail[there], (1, 99))
    median, highlights = np.percentile(grey[here], (50, 95))
    value = float(median) / 255  # to linear light (IEC 61966-2-1)
    clipped = (pixels[here] >= _CLIPPED).sum(axis=-1, dtype=np.uint8)
    measures = Measures(
        sharpness=sharpness(grey.astype(np.float32)),
        brightness=float(median),
        highlights=float(highlights),
        light=value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4,
        clipped=float(np.mean(clipped >= 1)),
        white=float(np.mean(clipped >= 2)),
        contrast=float(high - low),
        sky=_sky(thumbnail) if used is None or used[0].mean() >= _SKY_COLUMNS else 0.0,
    )
    return measures, thumbnail


def _inside(used: Bool[np.ndarray, "_ _"] | None, shape: tuple[int, ...]) -> np.ndarray | EllipsisType:
    """Index of the pixels of an image of a shape that are used as a whole; of all if there are none."""
    if used is None:
        return ...
    share = cv2.resize(used * np.uint8(255), shape[::-1], interpolation=cv2.INTER_AREA)
    return share == 255 if share.max() == 255 else ...


def sharpness(grey: Float32[np.ndarray, "H W"]) -> float:
    """Measure S(1) / S(8) without noise: minimum over directions, sharpest tenth of the textured blocks."""
    if min(grey.shape) < 2 * _FAR + _BLOCK:
        return math.nan
    noise = _noise_variance(grey)
    least = math.inf
    for direction in _DIRECTIONS:
        near = _structure(grey, _NEAR, direction) - 2 * noise
        far = _structure(grey, _FAR, direction) - 2 * noise
        textured = far > max(_TEXTURED, _ABOVE_NOISE * noise)
        if textured.mean() < _MIN_TEXTURED:
            return math.nan
        least = min(least, float(np.percentile(near[textured] / far[textured], _SHARPEST)))
    return max(least, 0.0)


def _structure(
    grey: Float32[np.ndarray, "H W"], step: int, direction: tuple[int, int]
) -> Float32[np.ndarray, "rows columns"]:
    """Mean squared difference per block between pixels `step` apart; the same pixels for all steps."""
    height, width = grey.shape
    down, right = direction[0] * step, direction[1] * step
    inner = grey[_FAR : height - _FAR, _FAR : width - _FAR]
    other = grey[_FAR + down : height - _FAR + down, _FAR + right : width - _FAR + right]
    return _block_means(np.square(inner - other))


def _block_means(values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "rows columns"]:
    rows, columns = values.shape[0] // _BLOCK, values.shape[1] // _BLOCK
    whole = values[: rows * _BLOCK, : columns * _BLOCK]
    return whole.reshape(rows, _BLOCK, columns, _BLOCK).mean(axis=(1, 3))


def _noise_variance(grey: Float32[np.ndarray, "H W"]) -> float:
    """Noise variance of the smoothest twentieth of the blocks, which have the least texture."""
    response = np.abs(cv2.filter2D(grey, -1, _NOISE_FILTER))[_FAR:-_FAR, _FAR:-_FAR]
    deviation = np.percentile(_block_means(response), 5) * math.sqrt(math.pi / 2) / 6
    return float(deviation) ** 2


def _sky(thumbnail: Float32[np.ndarray, "h w"]) -> float:
    """Share of a smooth region along the whole upper edge, with a straight lower edge, brighter than the rest."""
    height, width = thumbnail.shape
    mean = cv2.blur(thumbnail, (5, 5))
    deviation = np.sqrt(np.maximum(cv2.blur(thumbnail * thumbnail, (5, 5)) - mean * mean, 0))
    rough = deviation > _SKY_LEVELS
    depth = np.where(rough.any(axis=0), rough.argmax(axis=0), height)
    share = float(depth.mean()) / height
    if np.mean(depth > 0.05 * height) < _SKY_COLUMNS or share > 0.95:
        return 0.0
    columns = np.arange(width)
    ragged = depth - np.polyval(np.polyfit(columns, depth, 1), columns)
    above = np.arange(height)[:, None] < depth
    brighter = np.median(thumbnail[above]) > np.median(thumbnail[~above])
    return share if brighter and np.median(np.abs(ragged)) < _SKY_RAGGED * height else 0.0
