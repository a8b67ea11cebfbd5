"""What is told of the lenses: in pixels as COLMAP names their parameters, and in OpenSfM's normalised units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

from tidefield.survey.report.statistics import Statistics
from tidefield.survey.survey import Photograph

_OPENSFM_NAMES = {"f": "focal", "fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y", "k": "k1"}
_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")


def lenses(statistics: Statistics) -> list[dict[str, Any]]:
    """Every lens of the model: what it was found to be, what was known before, and `opensfm` as in `camera_errors`."""
    found: list[dict[str, Any]] = []
    for index, camera in enumerate(statistics.block.cameras):
        mine = np.flatnonzero(statistics.block.lens == index)
        photograph = next((p for p in (statistics.photographs[i] for i in mine) if p is not None), None)
        label = (photograph.camera if photograph else "") or "camera"
        if any(other["name"] == label for other in found):
            label = f"{label} ({index + 1})"
        names = [name.strip() for name in camera.params_info.split(",")]
        found.append(
            {
                "name": label,
                "photographs": len(mine),
                "width": camera.width,
                "height": camera.height,
                "model": camera.model_name,
                "parameters": dict(zip(names, camera.params, strict=True)),
                "focal_px": camera.mean_focal_length(),
                **_known_before(photograph, camera),
                "corner_distortion_px": _corner_distortion(camera),
                "opensfm": {
                    "initial_values": _initial(photograph, camera),
                    "optimized_values": _normalised(camera, names),
                },
            }
        )
    return found


def _known_before(photograph: Photograph | None, camera: pycolmap.Camera) -> dict[str, Any]:
    if photograph is None or photograph.lens is None:
        return {"prior_focal_px": None, "prior_source": None}
    scale = camera.width / photograph.width  # the model's images may be smaller than the originals
    return {"prior_focal_px": photograph.lens.focal_px * scale, "prior_source": photograph.lens.source}


def _initial(photograph: Photograph | None, camera: pycolmap.Camera) -> dict[str, float]:
    if photograph is None or photograph.lens is None:
        return {}
    focal = photograph.lens.focal_px / max(photograph.width, photograph.height)
    known = {"focal_x": focal, "focal_y": focal}
    if photograph.lens.distortion:
        known |= dict(zip(("k1", "k2", "p1", "p2", "k3"), photograph.lens.distortion, strict=True))
    return known


def _normalised(camera: pycolmap.Camera, names: list[str]) -> dict[str, float]:
    """Focal lengths, and offsets of the principal point from the middle, by the image's longer side."""
    side = max(camera.width, camera.height)
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    values = {}
    for name, value in zip(names, camera.params, strict=True):
        values[_OPENSFM_NAMES.get(name, name)] = (value - middle.get(name, 0)) / side if name in _IN_PIXELS else value
    return values


def _corner_distortion(camera: pycolmap.Camera) -> float:
    """How far distortion moves the image's corners, at most, in pixels."""
    corners = np.array([(0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)], dtype=float)
    straight = np.asarray(camera.cam_from_img(corners)) * (camera.focal_length_x, camera.focal_length_y)
    straight += (camera.principal_point_x, camera.principal_point_y)
    return float(np.linalg.norm(straight - corners, axis=1).max())
