"""Give two pictures of one place the same exposure and white balance, so that their difference has no part in these."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from tidefield.change.statistics import nmad

_DARK = 4.0
"""Added to 8-bit values before ratios are taken: what is darker is noise."""
_SAMPLE = 500_000
_TURNS = 4
_OUTLYING = 2.5
"""Robust deviations beyond which a pixel is taken to have changed and tells nothing of the light."""


def light_gains(
    earlier: UInt8[np.ndarray, "rows columns 3"],
    later: UInt8[np.ndarray, "rows columns 3"],
    region: Bool[np.ndarray, "rows columns"],
) -> Float32[np.ndarray, "3"]:
    """Estimate what the later picture's channels are multiplied by to have the earlier one's light.

    The median ratio of each channel, over pixels that agree with each other; in sRGB values, whose near power law
    keeps ratios ratios.
    """
    step = 1 + math.isqrt(max(0, int(region.sum()) - 1) // _SAMPLE)
    inside = region[::step, ::step]
    if not inside.any():
        return np.ones(3, np.float32)
    one, other = (picture[::step, ::step][inside].astype(np.float32) + _DARK for picture in (earlier, later))
    ratios = np.log(one / other)
    kept = np.ones(len(ratios), bool)
    middle = np.median(ratios, axis=0)
    for _ in range(_TURNS):
        spread = np.array([nmad(ratios[kept, c]) for c in range(3)]) + 1e-3  # two equal pictures have none
        kept = (np.abs(ratios - middle) < _OUTLYING * spread).all(axis=1)
        if not kept.any():
            break
        middle = np.median(ratios[kept], axis=0)
    return np.exp(middle).astype(np.float32)


def with_light(
    picture: UInt8[np.ndarray, "rows columns 3"], gains: Float32[np.ndarray, "3"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A picture with its channels multiplied."""
    return np.round((picture + _DARK) * gains - _DARK).clip(0, 255).astype(np.uint8)


def greenness(colours: Float32[np.ndarray, "*shape 3"]) -> Float32[np.ndarray, "*shape"]:
    """Excess green minus excess red: (3 G - 2.4 R - B) / (R + G + B).

    Meyer and Neto (2008), Verification of color vegetation indices for automated crop imaging applications, doi
    10.1016/j.compag.2008.03.009. How bright the light is cancels out.
    """
    red, green, blue = colours[..., 0], colours[..., 1], colours[..., 2]
    return (3 * green - 2.4 * red - blue) / (red + green + blue + np.float32(_DARK))
