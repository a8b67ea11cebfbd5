"""What differs between pictures of one place at two dates, but the light.

What only light changes is told from what changed on the ground: light makes a place brighter or darker and moves its
colour along the line from blue to yellow, which shade and other times of the day share. Along that line log(R B / G^2)
is constant (after Finlayson, Drew and Lu, Entropy minimization for shadow removal, 2009, doi
10.1007/s11263-008-0171-3, with the line of a camera whose channels are sRGB's). Heights and plants come from the
change itself. Ground that became wet is darker, too: pictures cannot tell it from shade.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from tidefield.change.statistics import nmad

SAME, LIGHT, COLOUR, LOWER, HIGHER, GAINED, LOST, UNKNOWN = range(8)
"""Kinds of difference: none, light only, colour of the ground, height, plants; not seen or not compared."""
_DARK = 6.0
_SMOOTH_PX = 2.0
_STANDS_OUT = 3.0
_LEAST_LIGHT, _LEAST_COLOUR = 0.15, 0.12
"""Differences of log values that are worth showing."""


@dataclass(frozen=True)
class View:
    """Views of both dates from one camera, the later one in the earlier one's light.

    Attributes:
        name: of the earlier photograph.
        kinds: of difference at each pixel.
    """

    name: str
    earlier: UInt8[np.ndarray, "H W 3"]
    later: UInt8[np.ndarray, "H W 3"]
    kinds: UInt8[np.ndarray, "H W"]

    def share(self, kind: int) -> float:
        """Of the pixels that are seen and compared at both dates."""
        seen = self.kinds != UNKNOWN
        return float((self.kinds[seen] == kind).mean()) if seen.any() else 0.0


def colour_kinds(
    earlier: UInt8[np.ndarray, "H W 3"], later: UInt8[np.ndarray, "H W 3"], steady: np.ndarray
) -> UInt8[np.ndarray, "H W"]:
    """Where pictures differ by light only, and where by the colour of the ground.

    Args:
        earlier, later: in one light, but for shadows.
        steady: pixels that noise is measured on.
    """
    logs = [
        np.log(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _SMOOTH_PX) + np.float32(_DARK))
        for picture in (earlier, later)
    ]
    difference = logs[1] - logs[0]
    bright = difference.mean(axis=2)
    across = difference[..., 0] + difference[..., 2] - 2 * difference[..., 1]
    kinds = np.full(bright.shape, SAME, np.uint8)
    if not steady.any():
        return kinds
    limits = [
        max(least, _STANDS_OUT * nmad(values[steady]))
        for values, least in ((bright, _LEAST_LIGHT), (across, _LEAST_COLOUR))
    ]
    kinds[np.abs(bright - np.median(bright[steady])) > limits[0]] = LIGHT
    kinds[np.abs(across - np.median(across[steady])) > limits[1]] = COLOUR
    return kinds
