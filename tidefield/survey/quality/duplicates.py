"""Find duplicates: photographs with the same view as another, of a hovering drone or of a copied file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8

from tidefield.survey.io.positions import positions_m
from tidefield.survey.survey import Photograph

MAX_SHIFT = 0.03
"""Largest shift of a duplicate, in longer sides: too short a baseline to measure heights."""
MIN_AGREEMENT = 0.6
"""Different views agree by at most 0.3, those of a hovering drone by 0.6 and more, even rotated by three degrees."""

# Accuracy of receivers, or this part of the flight height where it is larger.
_NEAR_M, _NEAR_OF_HEIGHT = 3.0, 0.05
_FAR_M = 20.0  # larger than the error of a receiver with a fix
_IN_SEQUENCE = 3
_COARSE = 16, 12
_MIN_CORRELATION = 0.5  # of the coarse outlines of two photographs, to compare them in full
_BLOCK = 20


def find_duplicates(
    photographs: Sequence[Photograph], outlines: Sequence[Int8[np.ndarray, "_ _"]], sharpness: Sequence[float]
) -> dict[int, str]:
    """Find the photographs of which a sharper duplicate exists.

    Compared are photographs taken within 3 m (or 5% of the flight height) of each other; and, if their positions are
    unknown or within 20 m, those within three of each other in time or with similar coarse outlines.

    Args:
        photographs: the photographs to compare.
        outlines: of each (see `outline`).
        sharpness: of each; NaN where unknown.

    Returns:
        The reason by index of the photograph.
    """
    coarse = np.array([_coarse(outline) for outline in outlines], np.float32).reshape(-1, _COARSE[0] * _COARSE[1])
    order = sorted(range(len(photographs)), key=lambda i: (-(sharpness[i] if sharpness[i] > 0 else 0.0), i))
    rank = np.argsort(np.array(capture_order(photographs), dtype=np.int64))
    xy_m = positions_m(photographs)
    kept: list[int] = []
    reasons = {}
    for index in order:
        others = np.array(kept, dtype=np.int64)
        height_m = photographs[index].relative_altitude_m
        near_m = max(_NEAR_M, _NEAR_OF_HEIGHT * height_m if height_m > 0 else 0.0)
        away_m = np.linalg.norm(xy_m[others] - xy_m[index], axis=1)  # NaN where a position is unknown
        likely = (np.abs(rank[others] - rank[index]) <= _IN_SEQUENCE) | (
            coarse[others] @ coarse[index] > _MIN_CORRELATION
        )
        for other in others[(away_m < near_m) | (likely & ~(away_m > _FAR_M))].tolist():
            if outlines[other].shape != outlines[index].shape:
                continue
            shift, agree = agreement(outlines[index], outlines[other])
            if shift < MAX_SHIFT and agree > MIN_AGREEMENT:
                reasons[index] = (
                    f"duplicate: it has the view of {photographs[other].name}, shifted by {shift:.1%} of its longer "
                    f"side (agreement {agree:.2f}); {MAX_SHIFT:.0%} (and {MIN_AGREEMENT}) is the limit."
                )
                break
        else:
            kept.append(index)
    return reasons


def capture_order(photographs: Sequence[Photograph]) -> list[int]:
    """Indices of photographs by time of capture, then by name; those without time first."""
    times = [photograph.time_s if math.isfinite(photograph.time_s) else 0.0 for photograph in photographs]
    return sorted(range(len(photographs)), key=lambda i: (times[i], photographs[i].name))


def outline(thumbnail: Float32[np.ndarray, "h w"]) -> Int8[np.ndarray, "h w"]:
    """Band-pass the log brightness of a grey thumbnail and normalise its contrast, so that exposure does not matter."""
    bright = np.log(thumbnail + 8)
    middle = cv2.GaussianBlur(bright, (0, 0), 1.5) - cv2.GaussianBlur(bright, (0, 0), 8)
    normalised = middle / np.sqrt(cv2.blur(middle * middle, (25, 25)) + 1e-4)  # the constant keeps flat regions flat
    return np.clip(np.round(normalised * 32), -127, 127).astype(np.int8)


def agreement(first: Int8[np.ndarray, "h w"], second: Int8[np.ndarray, "h w"]) -> tuple[float, float]:
    """Register two outlines; returns their shift, in longer sides, and their agreement after it.

    The shift is found by phase correlation. The agreement is the median correlation of blocks of 20 pixels, 1 for equal
    outlines. Roads and shores of the same direction agree in some blocks only.
    """
    a, b = first.astype(np.float32), second.astype(np.float32)
    right, down = _phase_correlation(a, b)
    move = np.array([[1, 0, right], [0, 1, down]], np.float32)
    moved = cv2.warpAffine(b, move, b.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    margin = 1 + math.ceil(max(abs(right), abs(down), 3))
    shift = math.hypot(right, down) / max(a.shape)
    if min(a.shape) < 2 * margin + _BLOCK:
        return shift, 0.0
    cells = []
    for image in (a, moved):
        inner = image[margin:-margin, margin:-margin]
        rows, columns = inner.shape[0] // _BLOCK, inner.shape[1] // _BLOCK
        whole = inner[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
        cell = whole.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
        cells.append(cell - cell.mean(axis=1, keepdims=True))
    energy = np.sqrt((cells[0] ** 2).sum(axis=1) * (cells[1] ** 2).sum(axis=1))
    return shift, float(np.median((cells[0] * cells[1]).sum(axis=1) / (energy + 1.0)))


def _phase_correlation(a: Float32[np.ndarray, "h w"], b: Float32[np.ndarray, "h w"]) -> tuple[float, float]:
    """Shift to the right and down in pixels, with b(x + shift) = a(x).

    `cv2.phaseCorrelate` is three times as fast, but 0.1 pixels off where this is 0.02 off: its peak is a centroid.
    """
    height, width = a.shape
    window = np.hanning(height)[:, None] * np.hanning(width)
    spectrum = np.fft.rfft2(a * window).conj() * np.fft.rfft2(b * window)
    size = np.abs(spectrum)
    # The constants keep frequencies that neither has from weighing as much as the others.
    surface = np.fft.irfft2(spectrum / (size + 1e-9 * size.max() + 1e-30), a.shape)
    surface: Float[np.ndarray, "h w"] = cv2.GaussianBlur(np.fft.fftshift(surface), (0, 0), 0.8)
    y, x = np.unravel_index(surface.argmax(), surface.shape)

    def between(before: float, peak: float, after: float) -> float:
        curvature = before - 2 * peak + after
        return 0.0 if curvature == 0 else float(np.clip((before - after) / (2 * curvature), -0.5, 0.5))

    right = between(surface[y, x - 1], surface[y, x], surface[y, (x + 1) % width])
    down = between(surface[y - 1, x], surface[y, x], surface[(y + 1) % height, x])
    return float(x + right - width // 2), float(y + down - height // 2)


def _coarse(outline: Int8[np.ndarray, "h w"]) -> Float32[np.ndarray, " 192"]:
    """A reduced outline of unit norm, insensitive to shifts of a fiftieth."""
    small = cv2.resize(outline.astype(np.float32), _COARSE, interpolation=cv2.INTER_AREA).ravel()
    small = small - small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)  # a flat one correlates with none
