"""What can be measured of one photograph's quality, by itself, on a reduced picture.

Sharpness comes from the structure function S(k), the mean squared difference of brightness between pixels k apart. On
natural ground it grows slowly, as k^0.5 to k^1; over less than the width of a blur it grows as k^2. So S(1) / S(8)
falls from about 0.3 to under 0.1 with a blur of six pixels, whatever the contrast. The noise adds the same to both and
is taken off. A movement blurs along one direction only, so the softest of four counts; smooth mud has few sharp places
but some, a blurred photograph none, so the sharpest tenth of the places counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8

SIDE_PX = 1600
"""Longer side of the picture that is measured: finer blur than this shows is no loss to a scene."""

_NEAR, _FAR = 1, 8
_BLOCK = 48
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_TEXTURED = 4.0  # mean squared difference (levels squared) from which on a block has texture to judge by
_ABOVE_NOISE = 20.0  # or as many times the noise's variance
_TEXTURED_AT_LEAST = 0.02
_SHARPEST = 90
# Immerkaer, Fast Noise Variance Estimation, 1996: blind to planes and straight edges.
_NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_CLIPPED = 253
_OUTLINE_PX = 160
_SKY_LEVELS = 3.5  # local standard deviation under which sky is smooth
_SKY_COLUMNS = 0.9
_SKY_RAGGED = 0.1


@dataclass(frozen=True)
class Measures:
    """One photograph's, in 8-bit levels where nothing else is said.

    Attributes:
        sharpness: S(1) / S(8), see above; NaN where there is too little texture to judge.
        brightness: median.
        highlights: 95th percentile of brightness.
        light: median of the linear light, 1 is white.
        clipped: share of pixels with at least one of the three colours at its upper end.
        white: share of pixels with at least two of them there, which leave no detail.
        contrast: between the 1st and the 99th percentile, of the picture reduced to where noise averages out.
        sky: share of the picture that is a smooth bright region along the whole upper edge.
    """

    sharpness: float
    brightness: float
    highlights: float
    light: float
    clipped: float
    white: float
    contrast: float
    sky: float


def measure(pixels: UInt8[np.ndarray, "H W 3"]) -> tuple[Measures, Int8[np.ndarray, "h w"]]:
    """The measures of an upright picture of at most `SIDE_PX`, and its outline."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, _OUTLINE_PX / max(grey.shape))
    size = max(16, round(grey.shape[1] * scale)), max(16, round(grey.shape[0] * scale))
    small = cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    low, high = np.percentile(small, (1, 99))
    median, highlights = np.percentile(grey, (50, 95))
    clipped = (pixels >= _CLIPPED).sum(axis=-1, dtype=np.uint8)
    measures = Measures(
        sharpness=sharpness(grey.astype(np.float32)),
        brightness=float(median),
        highlights=float(highlights),
        light=_linear(float(median)),
        clipped=float(np.mean(clipped >= 1)),
        white=float(np.mean(clipped >= 2)),
        contrast=float(high - low),
        sky=_sky(small),
    )
    return measures, outline(small)


def _linear(level: float) -> float:
    """sRGB's light at a level of 255."""
    value = level / 255
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def sharpness(grey: Float32[np.ndarray, "H W"]) -> float:
    """S(1) / S(8) without noise, in the direction where it is least, at the sharpest tenth of the textured blocks."""
    if min(grey.shape) < 2 * _FAR + _BLOCK:
        return math.nan
    noise = _noise_variance(grey)
    least = math.inf
    for direction in _DIRECTIONS:
        near = _structure(grey, _NEAR, direction) - 2 * noise
        far = _structure(grey, _FAR, direction) - 2 * noise
        textured = far > max(_TEXTURED, _ABOVE_NOISE * noise)
        if textured.mean() < _TEXTURED_AT_LEAST:
            return math.nan
        least = min(least, float(np.percentile(near[textured] / far[textured], _SHARPEST)))
    return max(least, 0.0)


def _structure(
    grey: Float32[np.ndarray, "H W"], step: int, direction: tuple[int, int]
) -> Float32[np.ndarray, "rows columns"]:
    """Mean squared difference, by block, between pixels that are `step` apart; the same pixels for all steps."""
    height, width = grey.shape
    down, right = direction[0] * step, direction[1] * step
    inner = grey[_FAR : height - _FAR, _FAR : width - _FAR]
    other = grey[_FAR + down : height - _FAR + down, _FAR + right : width - _FAR + right]
    return _blocks(np.square(inner - other))


def _blocks(values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "rows columns"]:
    rows, columns = values.shape[0] // _BLOCK, values.shape[1] // _BLOCK
    whole = values[: rows * _BLOCK, : columns * _BLOCK]
    return whole.reshape(rows, _BLOCK, columns, _BLOCK).mean(axis=(1, 3))


def _noise_variance(grey: Float32[np.ndarray, "H W"]) -> float:
    """Of the smoothest twentieth of the blocks, where the least of it is texture."""
    response = np.abs(cv2.filter2D(grey, -1, _NOISE_FILTER))[_FAR:-_FAR, _FAR:-_FAR]
    deviation = np.percentile(_blocks(response), 5) * math.sqrt(math.pi / 2) / 6
    return float(deviation) ** 2


def _sky(small: Float32[np.ndarray, "h w"]) -> float:
    """Share of a smooth region that hangs from the whole upper edge, ends in a straight line, and is the brighter."""
    height, width = small.shape
    mean = cv2.blur(small, (5, 5))
    deviation = np.sqrt(np.maximum(cv2.blur(small * small, (5, 5)) - mean * mean, 0))
    rough = deviation > _SKY_LEVELS
    depth = np.where(rough.any(axis=0), rough.argmax(axis=0), height)
    share = float(depth.mean()) / height
    if np.mean(depth > 0.05 * height) < _SKY_COLUMNS or share > 0.95:
        return 0.0
    columns = np.arange(width)
    ragged = depth - np.polyval(np.polyfit(columns, depth, 1), columns)
    above = np.arange(height)[:, None] < depth
    brighter = np.median(small[above]) > np.median(small[~above])
    return share if brighter and np.median(np.abs(ragged)) < _SKY_RAGGED * height else 0.0


def outline(small: Float32[np.ndarray, "h w"]) -> Int8[np.ndarray, "h w"]:
    """What is where, whatever the exposure: a reduced picture's middle frequencies of log brightness, evened out."""
    bright = np.log(small + 8)
    middle = cv2.GaussianBlur(bright, (0, 0), 1.5) - cv2.GaussianBlur(bright, (0, 0), 8)
    even = middle / np.sqrt(cv2.blur(middle * middle, (25, 25)) + 1e-4)  # nothing out of nothing
    return np.clip(np.round(even * 32), -127, 127).astype(np.int8)


def agreement(first: Int8[np.ndarray, "h w"], second: Int8[np.ndarray, "h w"]) -> tuple[float, float]:
    """How far two pictures are shifted against each other, in longer sides, and how well they agree then.

    The shift is found by phase correlation; the agreement is the median correlation of blocks of 20 pixels, 1 for equal
    pictures. Roads and shores that happen to run alike agree in some blocks only.
    """
    a, b = first.astype(np.float32), second.astype(np.float32)
    right, down = _shift(a, b)
    move = np.array([[1, 0, right], [0, 1, down]], np.float32)
    moved = cv2.warpAffine(b, move, b.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    margin, block = 1 + math.ceil(max(abs(right), abs(down), 3)), 20
    away = math.hypot(right, down) / max(a.shape)
    if min(a.shape) < 2 * margin + block:
        return away, 0.0
    cells = []
    for picture in (a, moved):
        inner = picture[margin:-margin, margin:-margin]
        rows, columns = inner.shape[0] // block, inner.shape[1] // block
        whole = inner[: rows * block, : columns * block].reshape(rows, block, columns, block)
        cell = whole.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
        cells.append(cell - cell.mean(axis=1, keepdims=True))
    energy = np.sqrt((cells[0] ** 2).sum(axis=1) * (cells[1] ** 2).sum(axis=1))
    return away, float(np.median((cells[0] * cells[1]).sum(axis=1) / (energy + 1.0)))


def _shift(a: Float32[np.ndarray, "h w"], b: Float32[np.ndarray, "h w"]) -> tuple[float, float]:
    """Right and down: b(x + shift) = a(x). (cv2.phaseCorrelate changes its inputs.)"""
    height, width = a.shape
    window = np.hanning(height)[:, None] * np.hanning(width)
    spectrum = np.fft.rfft2(a * window).conj() * np.fft.rfft2(b * window)
    size = np.abs(spectrum)
    # Frequencies that neither has would weigh as much as the others.
    surface = np.fft.irfft2(spectrum / (size + 1e-9 * size.max() + 1e-30), a.shape)
    surface: Float[np.ndarray, "h w"] = cv2.GaussianBlur(np.fft.fftshift(surface), (0, 0), 0.8)
    y, x = np.unravel_index(surface.argmax(), surface.shape)

    def between(before: float, peak: float, after: float) -> float:
        curvature = before - 2 * peak + after
        return 0.0 if curvature == 0 else float(np.clip((before - after) / (2 * curvature), -0.5, 0.5))

    right = between(surface[y, x - 1], surface[y, x], surface[y, (x + 1) % width])
    down = between(surface[y - 1, x], surface[y, x], surface[(y + 1) % height, x])
    return float(x + right - width // 2), float(y + down - height // 2)
